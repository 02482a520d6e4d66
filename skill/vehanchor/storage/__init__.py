"""Files that are written whole, and journals of long runs."""
