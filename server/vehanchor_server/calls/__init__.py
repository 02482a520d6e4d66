"""Execution of a call, from its admission to its reply."""
