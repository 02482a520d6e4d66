"""Fit of the votes of a detector's boxes for a scale."""
