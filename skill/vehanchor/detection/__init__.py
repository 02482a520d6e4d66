"""Vehicle detection: oriented boxes, model cards and contracts, and the search over an image."""
