"""How the bundled models are made; never imported by the library."""
