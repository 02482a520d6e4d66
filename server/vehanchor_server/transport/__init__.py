"""stdio and HTTP."""
