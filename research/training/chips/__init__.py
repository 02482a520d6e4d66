"""Training of the chip network: kind of a candidate, its ends and sides, its length and width."""
