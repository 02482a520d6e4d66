"""One object as a mask: prompt, segmenter, the SAM contracts, the mask's shape."""
