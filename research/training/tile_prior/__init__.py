"""Fitting where in a large image cars may be."""
