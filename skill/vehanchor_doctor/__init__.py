"""Checks of an installation and of a user's images."""
