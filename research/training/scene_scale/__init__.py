"""Training of the scene-scale network: a prior of the GSD from the scene."""
