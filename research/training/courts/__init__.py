"""The network that says where courts may be: ``README.md``."""
