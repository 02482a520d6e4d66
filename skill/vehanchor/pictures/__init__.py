"""Pictures of results: overlays and plots."""
