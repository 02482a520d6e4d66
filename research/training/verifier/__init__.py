"""Training of the verifier: whether a candidate is a car, by its pixels and surroundings."""
