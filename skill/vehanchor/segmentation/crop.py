"""Crop of the image for the segmenter: its window, its pixels, and the mask in it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.imagery.raster import Window

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster
    from vehanchor.segmentation.contracts import MaskLogits
    from vehanchor.segmentation.prompt import Prompt

MAX_POINT_CROP_PX = 1024
"""Largest crop in which points are tried, unless the object does not end in it."""

_BOX_CONTEXT = 2.0  # side of the crop over the box's longer side
_MIN_CROP_PX = 256
_MIN_POINT_CROP_PX = 128
_ROWS_PER_STRIP = 1024


def crop_side(prompt: Prompt) -> int:
    """Compute the side of a box's crop, or of the smallest one in which points are tried, pixels."""
    x1, y1, x2, y2 = prompt.extent
    least = _MIN_POINT_CROP_PX if prompt.box is None else _MIN_CROP_PX
    return max(least, math.ceil(_BOX_CONTEXT * max(x2 - x1, y2 - y1)))


def crop_window(prompt: Prompt, image_width_px: int, image_height_px: int, side_px: int) -> Window:
    """Place a square crop around a prompt, shifted and clipped to the image.

    Args:
        prompt: in pixels of the image.
        image_width_px: width of the image.
        image_height_px: height of the image.
        side_px: side of the square.

    Returns:
        A window of the image.
    """
    x1, y1, x2, y2 = prompt.extent
    width = min(side_px, image_width_px)
    height = min(side_px, image_height_px)
    left = math.floor((x1 + x2 - width) / 2 + 0.5)
    top = math.floor((y1 + y2 - height) / 2 + 0.5)
    return Window(
        min(max(left, 0), image_width_px - width),
        min(max(top, 0), image_height_px - height),
        width_px=width,
        height_px=height,
    )


def read_resized(raster: Raster, window: Window, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Read a window at another size, in strips: averaged if it shrinks, interpolated if it grows.

    Args:
        raster: the image.
        window: window of the image.
        size: width and height of the result.

    Returns:
        ``[h, w, 3]`` uint8 RGB.
    """
    width, height = size
    narrow = np.empty((window.height_px, width, 3), np.uint8)
    for top in range(0, window.height_px, _ROWS_PER_STRIP):
        rows = min(_ROWS_PER_STRIP, window.height_px - top)
        strip = raster.read(
            Window(window.x_px, window.y_px + top, width_px=window.width_px, height_px=rows)
        )
        narrow[top : top + rows] = _resized(strip, width, rows)
    return _resized(narrow, width, height)


def place_mask(found: MaskLogits) -> NDArray[np.bool_]:
    """Convert logits to the mask ``[h, w]`` of their crop: bilinear interpolation, the object where they are > 0."""
    grid = found.logits
    width_px = found.window.width_px
    height_px = found.window.height_px
    left, right, across = _between(width_px, found.cells_per_px[0], grid.shape[1])
    above, below, down = _between(height_px, found.cells_per_px[1], grid.shape[0])
    mask = np.empty((height_px, width_px), dtype=bool)
    for top in range(0, height_px, _ROWS_PER_STRIP):  # strips, to save memory
        part = slice(top, min(height_px, top + _ROWS_PER_STRIP))
        share = down[part, None]
        lines = grid[above[part]] * (1 - share) + grid[below[part]] * share
        mask[part] = lines[:, left] * (1 - across) + lines[:, right] * across > 0
    return mask


def _between(
    side_px: int, cells_per_px: float, n_cells: int
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
    """Find the cells before and after every pixel's centre, and the interpolation weight of the second."""
    at = np.clip((np.arange(side_px) + 0.5) * cells_per_px - 0.5, 0, n_cells - 1)
    before = at.astype(np.intp)
    return before, np.minimum(before + 1, n_cells - 1), (at - before).astype(np.float32)


def _resized(image: NDArray[np.uint8], width: int, height: int) -> NDArray[np.uint8]:
    if (height, width) == image.shape[:2]:
        return image
    shrinks = width < image.shape[1] or height < image.shape[0]
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    return cv2.resize(image, (width, height), interpolation=method).astype(np.uint8, copy=False)
