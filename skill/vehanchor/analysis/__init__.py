"""The analysis of an image: the pipeline to its scale, and results with their evidence, drawing and export."""
