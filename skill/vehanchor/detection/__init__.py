"""Vehicles as oriented boxes: the model's card and contracts, the search over an image."""
