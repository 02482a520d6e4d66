"""Segmentation of one object: prompt, segmenter, SAM contracts, and the mask's shape."""
