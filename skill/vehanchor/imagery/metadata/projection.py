"""Projection that a file states for its picture, if it is not one perspective view.

Spheres, panoramas and fisheye pictures have no single scale, and their metadata describe the camera
of one of their parts. Names and values:

* ``GPano``: Google's Photo Sphere XMP metadata, which drones, phones and stitching programs write.
* ``ModelType``: Pix4D's camera properties, which Parrot writes, too.
* ``CustomRendered``: Apple writes 6 for a panorama; the EXIF standard knows 0 and 1.
* ``LensModel``: the name of a fisheye lens.
* ``Make``: GoPro's wide fields of view are those of a fisheye lens; its linear ones have a longer
  35 mm equivalent.
* ``Make`` and ``Model`` of a camera for all directions, whose pictures are twice as wide as high.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vehanchor.imagery.formats.image_header import ImageHeader
    from vehanchor.imagery.metadata.statements import Statements

_PERSPECTIVE = ("perspective", "rectilinear", "planar", "frame")
"""Values of ``ProjectionType`` and ``ModelType`` for one perspective view."""

_APPLE_PANORAMA = 6
_FISHEYE = re.compile(r"fish.?eye", re.IGNORECASE)
_ALL_DIRECTIONS = re.compile(
    r"insta360|arashi vision|\btheta\b|gopro max|osmo 360|qoocam|kandao|gear 360|labpano|pilot era",
    re.IGNORECASE,
)
_SHOWN_CHARS = 32
_GOPRO_LINEAR_FROM_35MM = 18.0
"""Shortest 35 mm equivalent of linear fields of view, a choice: wide ones state 14 to 16."""


def stated_projection(statements: Statements, header: ImageHeader) -> str:
    """Name the projection of a picture that is not one perspective view.

    Args:
        statements: statements of the file.
        header: size of the image.

    Returns:
        The property and its value, such as "ProjectionType equirectangular"; empty for a
        perspective view, and if the file states nothing.
    """
    for name in ("ProjectionType", "ModelType"):
        value = statements.text(name)[:_SHOWN_CHARS]
        if value and value.casefold() not in _PERSPECTIVE:
            return f"{name} {value}"
    is_stated_perspective = bool(statements.text("ProjectionType"))
    if statements.text("FullPanoWidthPixels") and not is_stated_perspective:
        return "FullPanoWidthPixels of a panorama"
    has_viewer = statements.text("UsePanoramaViewer").casefold() == "true"
    if has_viewer and not is_stated_perspective:
        return "UsePanoramaViewer True"
    if statements.whole("CustomRendered") == _APPLE_PANORAMA:
        return "CustomRendered 6, a panorama"
    for name in ("LensModel", "Lens"):
        value = statements.text(name)[:_SHOWN_CHARS]
        if _FISHEYE.search(value):
            return f"{name} {value}"
    focal_35mm = statements.lens_number("FocalLengthIn35mmFilm")
    is_gopro = statements.text("Make").casefold().startswith("gopro")
    if is_gopro and focal_35mm is not None and focal_35mm < _GOPRO_LINEAR_FROM_35MM:
        return f"a wide field of view of GoPro, {focal_35mm:g} mm"
    camera = f"{statements.text('Make')} {statements.text('Model')}"[: 2 * _SHOWN_CHARS]
    is_twice_as_wide = header.width_px == 2 * header.height_px
    if is_twice_as_wide and not is_stated_perspective and _ALL_DIRECTIONS.search(camera):
        return f"all directions, by the size of a picture of {camera}"
    return ""
