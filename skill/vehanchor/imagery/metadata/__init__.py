"""Metadata of image files: EXIF, XMP, camera, georeference."""
