"""Engines of a batch run: processes of this machine, or Ray."""
