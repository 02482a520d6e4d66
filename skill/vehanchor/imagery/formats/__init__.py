"""File formats: headers and decoders."""
