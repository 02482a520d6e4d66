"""Training code and benchmarks, the sources of weights and numbers. Nothing else imports this package."""
