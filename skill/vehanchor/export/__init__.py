"""Export of results to files of other programs."""

MAX_ENLARGEMENT = 2.0
"""Largest factor of a copy unless the caller allows more.

Beyond it, a model sees only interpolated pixels. It stands here, because help states it, and loads
nothing that makes copies.
"""
