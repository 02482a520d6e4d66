"""Results with what they came from, drawing and export."""
