"""Tile grid: overlapping tiles that cover an image at full or reduced resolution."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.imagery.raster import Window

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster

TILE_SIZE_PX = 1024  # paper, section III-B
TILE_OVERLAP = 0.25  # paper, section III-B: stride 768 px at 1024 px
_BLOCK_PX = 1024  # side of a block of a reduced window, 3 MiB


def _starts(extent: int, tile: int, stride: int) -> list[int]:
    """Compute tile origins along one axis; the last tile ends at the image's edge."""
    if extent <= tile:
        return [0]
    return [*range(0, extent - tile, stride), extent - tile]


def tile_grid(
    width_px: int, height_px: int, *, tile_px: int = TILE_SIZE_PX, stride_px: int | None = None
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
    step = round(tile_px * (1 - TILE_OVERLAP)) if stride_px is None else stride_px
    return [
        Window(x, y, width_px=min(tile_px, width_px), height_px=min(tile_px, height_px))
        for y in _starts(height_px, tile_px, step)
        for x in _starts(width_px, tile_px, step)
    ]


def read_reduced_window(raster: Raster, window: Window, factor: int) -> NDArray[np.uint8]:
    """Read a window of a raster reduced by a whole factor; each pixel is the mean of ``factor`` x ``factor`` pixels.

    The image is read block by block, so memory holds only the result and one block.

    Args:
        raster: the image.
        window: in pixels of the reduced image, which has ``width_px // factor`` x ``height_px //
            factor``.
        factor: reduction factor; 1 reads the window unreduced.

    Returns:
        ``[h, w, 3]`` uint8 RGB.
    """
    if factor == 1:
        return raster.read(window)
    step = max(1, _BLOCK_PX // factor)
    reduced = np.empty((window.height_px, window.width_px, 3), np.uint8)
    for top in range(0, window.height_px, step):
        rows = min(step, window.height_px - top)
        for left in range(0, window.width_px, step):
            columns = min(step, window.width_px - left)
            x = (window.x_px + left) * factor
            y = (window.y_px + top) * factor
            block = raster.read(Window(x, y, width_px=columns * factor, height_px=rows * factor))
            reduced[top : top + rows, left : left + columns] = cv2.resize(
                block, (columns, rows), interpolation=cv2.INTER_AREA
            )
    return reduced


def read_around(
    raster: Raster, box: NDArray[np.float64], factor: int, reach: float
) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """Read the surroundings of a box, reduced by a whole factor.

    Args:
        raster: the image.
        box: ``[5]``, ``(x, y, length, width, angle)`` in image pixels, centred inside the image.
        factor: reduction factor.
        reach: lengths of the box from its centre to the sides of the window.

    Returns:
        ``[h, w, 3]`` uint8 RGB, cut off at the image's edges, and the box ``[5]`` in its pixels.
    """
    width = raster.width_px // factor
    height = raster.height_px // factor
    x, y, length, breadth = box[:4] / factor
    left, right = (round(np.clip(x + side * reach * length, 0, width)) for side in (-1, 1))
    top, bottom = (round(np.clip(y + side * reach * length, 0, height)) for side in (-1, 1))
    left = min(left, width - 1)
    top = min(top, height - 1)
    window = Window(left, top, width_px=max(1, right - left), height_px=max(1, bottom - top))
    pixels = read_reduced_window(raster, window, factor)
    return pixels, np.array([x - left, y - top, length, breadth, box[4]])


def read_preview(raster: Raster, window: Window, factor: int) -> NDArray[np.uint8]:
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
    return read_reduced_window(raster, window, factor) if overview is None else overview
