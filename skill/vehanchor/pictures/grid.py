"""Picture for pointing: an image or a part of it, with a light grid labelled in image pixels."""

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
    from vehanchor.options.pixel_grid import PixelGrid
    from vehanchor.pictures.placement import RgbImage

# Approximate number of lines along the longer side.
_N_LINES = 11
_LINE_OPACITY = 0.35
# Longer side of the picture over the height of capitals.
_SIDE_PER_CAPITAL = 95
_MIN_CAPITAL_PX = 8
_MAX_CAPITAL_PX = 14
# Distance of a label from its line, pixels.
_LABEL_GAP_PX = 3


def draw_grid(
    raster: Raster,
    part: Window,
    long_side_px: int,
    max_enlargement: float,
    lines: bool,
) -> tuple[RgbImage, int]:
    """Draw a part of an image at a given size, enlarged by a limited factor.

    Args:
        raster: the image.
        part: window of the image, in square pixels.
        long_side_px: longer side of the picture.
        max_enlargement: largest side of the image's pixels in the picture.
        lines: whether to draw the grid.

    Returns:
        ``[h, w, 3]`` RGB, and the distance of two grid lines in pixels of the file.
    """
    pixels = read_reduced(raster, part)
    cut = Cut(part, long_side_px)
    rgb = cut.sized(pixels, max_enlargement, cv2.INTER_CUBIC)
    left, top, right, bottom = window_in_file(part, raster.grid).tolist()
    long_side = max(right - left, bottom - top)
    step = _round_step(long_side / _N_LINES)
    if lines:
        _draw_lines(rgb, (left, top, right, bottom), step)
    return rgb, step


def window_in_file(part: Window, grid: PixelGrid) -> NDArray[np.float64]:
    """Convert a window to pixels of the file: ``[4]`` left, top, right, bottom."""
    right = part.x_px + part.width_px
    bottom = part.y_px + part.height_px
    corners = grid.to_file([(part.x_px, part.y_px), (right, bottom)])
    return corners.ravel()


def _draw_lines(rgb: RgbImage, extent: tuple[float, float, float, float], step: int) -> None:
    """Draw lines at round pixels of the file over a picture of this extent of the file."""
    height, width = rgb.shape[:2]
    left, top, right, bottom = extent
    across = width / (right - left)
    down = height / (bottom - top)
    columns = {x: round((x - left) * across) for x in _multiples(step, left, right)}
    rows = {y: round((y - top) * down) for y in _multiples(step, top, bottom)}
    for column in columns.values():
        _lighten(rgb[:, column : column + 1])
    for row in rows.values():
        _lighten(rgb[row : row + 1])
    # Labels last, so that no line crosses them.
    capital = max(width, height) // _SIDE_PER_CAPITAL
    capital = min(_MAX_CAPITAL_PX, max(_MIN_CAPITAL_PX, capital))
    for x, column in columns.items():
        start = (column + _LABEL_GAP_PX, capital + _LABEL_GAP_PX)
        write_on(rgb, f"{x}", start, capital_px=capital)
    for y, row in rows.items():
        start = (_LABEL_GAP_PX, row - _LABEL_GAP_PX)
        write_on(rgb, f"{y}", start, capital_px=capital)


def _round_step(pixels: float) -> int:
    """Round up to 1, 2 or 5 times a power of ten."""
    exponent = math.floor(math.log10(max(1.0, pixels)))
    power = 10.0**exponent
    steps = [multiple * power for multiple in (1, 2, 5, 10)]
    return int(next(step for step in steps if step >= pixels - 1e-9))


def _multiples(step: int, start: float, end: float) -> range:
    """List the multiples of a step inside a range, without its edges."""
    first = (math.floor(start / step) + 1) * step
    return range(first, math.ceil(end), step)


def _lighten(line: RgbImage) -> None:
    lighter = (1 - _LINE_OPACITY) * line + _LINE_OPACITY * 255
    line[:] = np.rint(lighter).astype(np.uint8)
