"""Picture for pointing: an image, or a part of it, with a light grid labelled in the image's pixels."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.pictures.lettering import write_on
from vehanchor.pictures.placement import Cut
from vehanchor.pictures.scale import read_reduced

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster, Window

_LINES = 11  # approximate number along the longer side
_LIGHT = 0.35  # opacity of the white lines
_TEXT_SHARE = 95  # longer side over the height of capitals
_MIN_TEXT_PX = 8
_MAX_TEXT_PX = 14


def draw_grid(
    raster: Raster, part: Window, long_side_px: int, max_enlargement: float, lines: bool
) -> tuple[NDArray[np.uint8], int]:
    """Draw a part of an image at a given size, enlarged by a limited factor.

    Args:
        raster: the image.
        part: window of the image.
        long_side_px: longer side of the picture.
        max_enlargement: largest side of the image's pixels in the picture.
        lines: whether to draw the grid.

    Returns:
        ``[h, w, 3]`` RGB, and the distance of two grid lines in pixels of the image.
    """
    rgb = Cut(part, long_side_px).sized(
        read_reduced(raster, part), max_enlargement, cv2.INTER_CUBIC
    )
    step = _round_step(max(part.width_px, part.height_px) / _LINES)
    if lines:
        _draw_lines(rgb, part, step)
    return rgb, step


def _draw_lines(rgb: NDArray[np.uint8], part: Window, step: int) -> None:
    height, width = rgb.shape[:2]
    across = width / part.width_px
    down = height / part.height_px
    columns = [
        (x, round((x - part.x_px) * across)) for x in _multiples(step, part.x_px, part.width_px)
    ]
    rows = [(y, round((y - part.y_px) * down)) for y in _multiples(step, part.y_px, part.height_px)]
    for _, at in columns:
        _lighten(rgb[:, at : at + 1])
    for _, at in rows:
        _lighten(rgb[at : at + 1])
    capital = min(_MAX_TEXT_PX, max(_MIN_TEXT_PX, max(width, height) // _TEXT_SHARE))
    for x, at in columns:
        write_on(rgb, f"{x}", at=(at + 3, capital + 3), capital_px=capital)
    for y, at in rows:
        write_on(rgb, f"{y}", at=(3, at - 3), capital_px=capital)


def _round_step(pixels: float) -> int:
    """Round up to 1, 2 or 5 times a power of ten."""
    power = 10.0 ** math.floor(math.log10(max(1.0, pixels)))
    return int(next(m * power for m in (1, 2, 5, 10) if m * power >= pixels - 1e-9))


def _multiples(step: int, start: int, length: int) -> range:
    """List the multiples of a step inside a range, without its edges."""
    return range((start // step + 1) * step, start + length, step)


def _lighten(line: NDArray[np.uint8]) -> None:
    line[:] = np.rint((1 - _LIGHT) * line + _LIGHT * 255).astype(np.uint8)
