"""Reconstructions (OpenSfM, OpenDroneMap, COLMAP) and the factor that gives them their size."""
