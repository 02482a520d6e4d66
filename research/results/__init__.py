"""What was measured: data files, the helper that writes them, and the page that is generated from them."""
