"""Training of the network that proposes courts; see ``README.md``."""
