"""Trains the bundled promptable segmenter; see README.md."""
