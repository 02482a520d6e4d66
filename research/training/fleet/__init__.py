"""Training of the network that classifies fleets."""
