"""Rulers: one file each, from a view of an image to evidence of its scale."""
