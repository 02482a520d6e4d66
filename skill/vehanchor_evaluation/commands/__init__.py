"""The commands `evaluate` and `calibrate`."""
