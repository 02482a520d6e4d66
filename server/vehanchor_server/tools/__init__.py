"""The tools, and how they answer."""
