"""Training of the second look: whether what the detector found is a car, by its look and its surroundings."""
