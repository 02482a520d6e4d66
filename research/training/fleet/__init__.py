"""Training of the network that tells fleets apart."""
