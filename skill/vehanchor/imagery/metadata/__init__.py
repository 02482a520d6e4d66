"""Metadata in image files: EXIF, XMP, camera, georeference."""
