"""Training the network that tells from the ground alone how big a pixel is, roughly."""
