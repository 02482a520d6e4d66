"""Analysis of an image: the pipeline to its scale, and results with drawing and export."""
