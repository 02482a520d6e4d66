"""Image input: sources, formats, metadata, windows, tiles, resolved detail."""
