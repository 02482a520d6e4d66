"""Analysis of an image: the pipeline to its scale, results with drawing and export, its process."""
