"""Where images come from: paths, arrays, datasets, addresses."""
