"""Reading benchmark data and measuring against it."""
