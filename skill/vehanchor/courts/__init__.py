"""Sports courts in an image: painted lines of known size, found and fitted."""
