"""Tile grid: overlapping tiles that cover an image at full or reduced resolution."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeAlias

import cv2
import numpy as np

from vehanchor.imagery.raster import Window

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster, RgbImage

    Box: TypeAlias = NDArray[np.float64]
    """``[5]``, ``(x, y, length, width, angle)``, pixels and radians."""

TILE_SIZE_PX = 1024
"""Side of a tile (paper, section III-B)."""

TILE_OVERLAP = 0.25
"""Share of a tile that its neighbour covers, too: a stride of 768 px (paper, section III-B)."""

_BLOCK_PX = 1024
"""Side of a block in which a window is read before it is reduced: 3 MiB of pixels."""

_MAX_SMALL_PIXELS = 64_000_000
"""Most pixels of an image that is read whole for a small copy. A choice: larger images are mosaics,
and reading them takes seconds."""


def tile_grid(
    width_px: int,
    height_px: int,
    *,
    tile_px: int = TILE_SIZE_PX,
    stride_px: int | None = None,
) -> list[Window]:
    """Lay out the tiles of an image in reading order.

    Args:
        width_px: image width.
        height_px: image height.
        tile_px: side of a tile; a smaller image has one tile of its own size.
        stride_px: step between tiles, at most ``tile_px``; default three quarters of it (25 %
            overlap).

    Returns:
        Distinct windows that cover every pixel of the image.
    """
    if stride_px is None:
        stride_px = round(tile_px * (1 - TILE_OVERLAP))
    tile_width_px = min(tile_px, width_px)
    tile_height_px = min(tile_px, height_px)
    return [
        Window(x, y, width_px=tile_width_px, height_px=tile_height_px)
        for y in _tile_starts(height_px, tile_px, stride_px)
        for x in _tile_starts(width_px, tile_px, stride_px)
    ]


def _tile_starts(side_px: int, tile_px: int, stride_px: int) -> list[int]:
    """Compute the tiles' first pixels along a side; the last tile ends at the image's edge."""
    if side_px <= tile_px:
        return [0]
    last = side_px - tile_px
    return [*range(0, last, stride_px), last]


def read_reduced_window(raster: Raster, window: Window, factor: int) -> RgbImage:
    """Read a window of a raster reduced by a whole factor.

    Each pixel is the mean of ``factor`` x ``factor`` pixels of the image.

    The image is read block by block, so memory holds only the result and one block.

    Args:
        raster: the image.
        window: in pixels of the reduced image, which has ``width_px // factor`` columns and
            ``height_px // factor`` rows.
        factor: reduction factor; 1 reads the window unreduced.

    Returns:
        ``[h, w, 3]`` uint8 RGB.
    """
    if factor == 1:
        return raster.read(window)
    reduced = np.empty((window.height_px, window.width_px, 3), np.uint8)
    step = max(1, _BLOCK_PX // factor)
    # Rows, columns, top and left are those of a block in the result.
    for top in range(0, window.height_px, step):
        rows = min(step, window.height_px - top)
        for left in range(0, window.width_px, step):
            columns = min(step, window.width_px - left)
            full_resolution = Window(
                (window.x_px + left) * factor,
                (window.y_px + top) * factor,
                width_px=columns * factor,
                height_px=rows * factor,
            )
            block = raster.read(full_resolution)
            size = (columns, rows)
            mean = cv2.resize(block, size, interpolation=cv2.INTER_AREA)
            reduced[top : top + rows, left : left + columns] = mean
    return reduced


def read_small_grey(raster: Raster, side_px: int) -> tuple[NDArray[np.uint8], int] | None:
    """Read the grey values of a whole image, reduced by a whole factor.

    Args:
        raster: the image.
        side_px: longest side of the reduced image.

    Returns:
        ``[h, w]`` grey values, and the factor; None for an image of more than 64 megapixels, and
        for one of which less than a row or column is left.
    """
    if raster.width_px * raster.height_px > _MAX_SMALL_PIXELS:
        return None
    factor = math.ceil(max(raster.width_px, raster.height_px) / side_px)
    width_px = raster.width_px // factor
    height_px = raster.height_px // factor
    if not width_px or not height_px:
        return None
    window = Window(0, 0, width_px=width_px, height_px=height_px)
    pixels = read_reduced_window(raster, window, factor)
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), np.uint8), factor


def read_around(raster: Raster, box: Box, factor: int, reach: float) -> tuple[RgbImage, Box]:
    """Read the surroundings of a box, reduced by a whole factor.

    Args:
        raster: the image.
        box: ``[5]``, ``(x, y, length, width, angle)`` in image pixels, centred inside the image.
        factor: reduction factor.
        reach: lengths of the box from its centre to the sides of the window.

    Returns:
        ``[h, w, 3]`` uint8 RGB, cut off at the image's edges, and the box ``[5]`` in its pixels.
    """
    reduced_width = raster.width_px // factor
    reduced_height = raster.height_px // factor
    angle = box[4]
    x, y, length, width = box[:4] / factor
    distance = reach * length
    # The window is cut off at the image's edges and keeps at least one pixel.
    left, columns = _span(x - distance, x + distance, reduced_width)
    top, rows = _span(y - distance, y + distance, reduced_height)
    window = Window(left, top, width_px=columns, height_px=rows)
    pixels = read_reduced_window(raster, window, factor)
    box_in_window = np.array([x - left, y - top, length, width, angle])
    return pixels, box_in_window


def _span(start: float, end: float, side_px: int) -> tuple[int, int]:
    """Round an interval to whole pixels of a side; return its first pixel and its length."""
    first = round(np.clip(start, 0, side_px))
    last = round(np.clip(end, 0, side_px))
    first = min(first, side_px - 1)
    return first, max(1, last - first)


def read_preview(raster: Raster, window: Window, factor: int) -> RgbImage:
    """Read a window of a raster reduced by a whole factor, from the file's overviews if it has any.

    Overviews are fast but can be resampled in other ways: use previews for search, not for
    measurement.

    Args:
        raster: the image.
        window: as in ``read_reduced_window``.
        factor: as in ``read_reduced_window``.

    Returns:
        ``[h, w, 3]`` uint8 RGB.
    """
    overview = raster.read_overview(window, factor)
    if overview is None:
        return read_reduced_window(raster, window, factor)
    return overview
