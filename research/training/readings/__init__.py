"""Readings of cars by eye: kinds, ends and sides."""
