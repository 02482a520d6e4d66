"""Measure the library and the server; each module is a command."""
