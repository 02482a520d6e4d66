"""Mathematics of the scale: lengths in pixels to metres per pixel, intervals and confidence."""
