"""Analyses: results with their evidence, drawing and export."""
