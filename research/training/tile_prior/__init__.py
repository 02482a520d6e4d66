"""Fit of the tile prior."""
