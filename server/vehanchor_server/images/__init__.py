"""Image sources: argument, path access, fetching."""
