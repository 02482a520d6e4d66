"""Image sources: paths, arrays, datasets, addresses."""
