"""Tilt: where the camera looked, and the ground plane."""
