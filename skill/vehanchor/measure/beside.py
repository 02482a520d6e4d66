"""Measurements beside the photograph in a page or program, where its scale does not hold."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.imagery.raster import Window
    from vehanchor.options.reading import Place
    from vehanchor.segmentation.object_mask import ObjectMask

# Share of an object that may lie beside the photograph, and distance of a point from it over its
# longer side: outlines along its border are not exact. Choices.
_MAX_SHARE_BESIDE = 0.1
_MAX_DISTANCE = 0.02

BESIDE_PHOTOGRAPH = Notice(
    code=NoticeCode.BESIDE_PHOTOGRAPH,
    message=(
        "What is measured lies beside the photograph in this picture, whose scale need not hold "
        "there. Measure inside the photograph, or give the other picture alone."
    ),
)


def is_object_beside(pixels: ObjectMask, part: Window | None) -> bool:
    """Test whether an object lies beside the photograph.

    Args:
        pixels: the object's mask.
        part: the photograph in its picture; None if all of the picture is one.
    """
    n_px = int(pixels.mask.sum())
    if part is None or n_px == 0:
        return False
    left = max(0, part.x_px - pixels.window.x_px)
    top = max(0, part.y_px - pixels.window.y_px)
    right = max(0, part.x_px + part.width_px - pixels.window.x_px)
    bottom = max(0, part.y_px + part.height_px - pixels.window.y_px)
    n_inside = int(pixels.mask[top:bottom, left:right].sum())
    return n_px - n_inside > _MAX_SHARE_BESIDE * n_px


def is_path_beside(points: Sequence[Place], part: Window | None) -> bool:
    """Test whether a path leaves the photograph; see ``is_object_beside``."""
    if part is None:
        return False
    tolerance_px = _MAX_DISTANCE * max(part.width_px, part.height_px)
    for x, y in points:
        across_px = max(part.x_px - x, x - part.x_px - part.width_px)
        down_px = max(part.y_px - y, y - part.y_px - part.height_px)
        if max(across_px, down_px) > tolerance_px:
            return True
    return False
