"""Areas and distances at a scale."""
