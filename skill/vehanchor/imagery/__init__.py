"""Image input: sources, formats, metadata, windows, tiles, detail."""
