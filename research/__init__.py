"""Training code and benchmarks, the sources of weights and numbers; nothing imports them."""
