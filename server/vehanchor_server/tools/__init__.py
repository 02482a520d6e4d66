"""The tools, one module each, and their shared parts."""
