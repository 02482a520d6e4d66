"""Fitting how the boxes of a detector vote for a scale."""
