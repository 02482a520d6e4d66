"""Tilt of the camera and the ground plane that it implies."""
