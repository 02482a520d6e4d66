"""Crop that a file states: by its editor, or by a size of another shape.

Editors write the size of the crop into the camera's tags, so that it looks like a whole photograph,
and leave the original size elsewhere:

* ``HasCrop`` with ``AlreadyApplied``: Adobe's Camera Raw and Lightroom, in exported files. Settings
  that are not applied belong to a whole photograph.
* ``ImageWidth`` and ``ImageLength``, in EXIF's first directory or in XMP, and ``PixelXDimension``
  and ``PixelYDimension`` in XMP.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vehanchor.imagery.formats.image_header import ImageHeader
    from vehanchor.imagery.metadata.statements import Statements

_SIZE_NAMES = (("ImageWidth", "ImageLength"), ("PixelXDimension", "PixelYDimension"))

_SHAPE_TOLERANCE = 0.02
"""Relative difference of shapes up to which a size can be that of the whole photograph.

Sizes of raw files have some more rows and columns. A choice.
"""


def stated_crop(statements: Statements, header: ImageHeader) -> str:
    """Say what shows that an image is a part of the photograph.

    Args:
        statements: statements of the file.
        header: size of the image.

    Returns:
        A clause; empty if nothing does.
    """
    is_applied = statements.text("AlreadyApplied").casefold() == "true"
    if is_applied and statements.text("HasCrop").casefold() == "true":
        return "its editor states HasCrop"
    if not header.width_px or not header.height_px:
        return ""  # a damaged file, which opening it refuses
    for names in _SIZE_NAMES:
        # A TIFF's own tags of this name are those of its picture.
        for width, height in statements.sizes(*names):
            if not _is_alike(width / height, header.width_px / header.height_px):
                return (
                    f"the file also states {width:.0f} x {height:.0f} px ({names[0]}), and the "
                    f"image has {header.width_px} x {header.height_px}"
                )
    return ""


def _is_alike(first: float, second: float) -> bool:
    """Test whether two ratios of width and height are those of one picture, turned or not."""
    ratios = (first / second, first * second)
    return any(abs(ratio - 1.0) <= _SHAPE_TOLERANCE for ratio in ratios)
