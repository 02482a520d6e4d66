"""Training code and benchmarks: how the weights and the numbers were made. Nothing else imports this package."""
