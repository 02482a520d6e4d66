"""Training of the verifier: whether a candidate of the detector is a car, by its pixels and their surroundings."""
