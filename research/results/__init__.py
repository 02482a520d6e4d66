"""Results: data files, the helper that writes them, and the generated page."""
