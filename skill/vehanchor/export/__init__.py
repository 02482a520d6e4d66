"""Export of results to files of other programs."""
