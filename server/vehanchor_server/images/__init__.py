"""How a picture reaches the server: argument, sandboxed path, fetched URL."""
