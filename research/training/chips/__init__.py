"""Training of the chip network: what a candidate is, where its ends and sides lie, and how long and wide it looks."""
