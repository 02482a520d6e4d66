"""Training of the car verifier: a larger network for photographs in which few candidates are found."""
