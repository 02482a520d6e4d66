"""Images in: decoding, windows, tiles, georeference, how much detail there is."""
