"""Image sources: paths, arrays, datasets."""
