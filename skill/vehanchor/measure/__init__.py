"""Areas and distances at a resolved scale."""
