"""Rulers: one file each, from what is in a picture to evidence of its scale."""
