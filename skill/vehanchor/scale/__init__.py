"""From lengths in pixels to metres per pixel, its interval and its confidence."""
