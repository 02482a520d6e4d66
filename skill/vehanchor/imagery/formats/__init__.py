"""Formats of image files: headers, and decoding of whole images."""
