"""Crop of the image for the segmenter: its window, its pixels, and the mask in it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import cv2
import numpy as np

from vehanchor.imagery.raster import Window

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster
    from vehanchor.segmentation.contracts import MaskLogits
    from vehanchor.segmentation.prompt import Prompt
    from vehanchor.segmentation.shape import Mask

    RgbImage: TypeAlias = NDArray[np.uint8]
    """``[h, w, 3]`` RGB."""

MAX_POINT_CROP_PX = 1024
"""Largest crop in which points are tried, unless the object does not end in it."""

# Side of the crop over the longer side of the box.
_BOX_CONTEXT = 2.0
_MIN_BOX_CROP_PX = 256
_MIN_POINT_CROP_PX = 128
_ROWS_PER_STRIP = 1024


def crop_side(prompt: Prompt) -> int:
    """Compute the side of a crop, pixels: of a box's, or of the smallest one for points."""
    x1, y1, x2, y2 = prompt.extent
    longer_side = max(x2 - x1, y2 - y1)
    min_side = _MIN_BOX_CROP_PX
    if prompt.box is None:
        min_side = _MIN_POINT_CROP_PX
    return max(min_side, math.ceil(_BOX_CONTEXT * longer_side))


def crop_window(prompt: Prompt, image_width_px: int, image_height_px: int, side_px: int) -> Window:
    """Place a square crop around a prompt, shifted and clipped to the image.

    Args:
        prompt: prompt in pixels of the image.
        image_width_px: width of the image.
        image_height_px: height of the image.
        side_px: side of the square.

    Returns:
        A window of the image.
    """
    x1, y1, x2, y2 = prompt.extent
    width = min(side_px, image_width_px)
    height = min(side_px, image_height_px)
    # Centred on the prompt, then shifted into the image.
    left = math.floor((x1 + x2 - width) / 2 + 0.5)
    top = math.floor((y1 + y2 - height) / 2 + 0.5)
    max_left = image_width_px - width
    max_top = image_height_px - height
    left = min(max(left, 0), max_left)
    top = min(max(top, 0), max_top)
    return Window(left, top, width_px=width, height_px=height)


def read_resized(raster: Raster, window: Window, size: tuple[int, int]) -> RgbImage:
    """Read a window at another size: averaged if it shrinks, interpolated if it grows.

    Args:
        raster: the image.
        window: window of the image.
        size: width and height of the result.

    Returns:
        ``[h, w, 3]`` uint8 RGB.
    """
    width, height = size
    # In strips, first to the final width: a huge window is never whole in memory.
    narrow = np.empty((window.height_px, width, 3), np.uint8)
    for top in range(0, window.height_px, _ROWS_PER_STRIP):
        rows = min(_ROWS_PER_STRIP, window.height_px - top)
        strip = Window(
            window.x_px,
            window.y_px + top,
            width_px=window.width_px,
            height_px=rows,
        )
        pixels = raster.read(strip)
        narrow[top : top + rows] = _resize(pixels, width, rows)
    return _resize(narrow, width, height)


def place_mask(chosen: MaskLogits) -> Mask:
    """Convert logits to the mask ``[h, w]`` of their crop.

    The logits are interpolated bilinearly at the pixels' centres; the object is where they are
    above 0.
    """
    grid = chosen.logits
    width_px = chosen.window.width_px
    height_px = chosen.window.height_px
    n_rows, n_columns = grid.shape
    columns_per_px, rows_per_px = chosen.cells_per_px
    columns = _neighbours(width_px, columns_per_px, n_columns)
    rows = _neighbours(height_px, rows_per_px, n_rows)
    mask = np.empty((height_px, width_px), dtype=bool)
    # In strips, to save memory: first between rows of the grid, then between its columns.
    for top in range(0, height_px, _ROWS_PER_STRIP):
        strip = slice(top, min(height_px, top + _ROWS_PER_STRIP))
        weight = rows.weight[strip, None]
        above = grid[rows.before[strip]]
        below = grid[rows.after[strip]]
        lines = above * (1 - weight) + below * weight
        left = lines[:, columns.before]
        right = lines[:, columns.after]
        logits = left * (1 - columns.weight) + right * columns.weight
        mask[strip] = logits > 0
    return mask


class _Neighbours(NamedTuple):
    """Cells beside each pixel's centre, along one axis.

    Attributes:
        before: ``[n]`` index of the cell before or at the centre.
        after: ``[n]`` index of the next cell.
        weight: ``[n]`` interpolation weight of the next cell, 0..1.
    """

    before: NDArray[np.intp]
    after: NDArray[np.intp]
    weight: NDArray[np.float32]


def _neighbours(side_px: int, cells_per_px: float, n_cells: int) -> _Neighbours:
    last = n_cells - 1
    pixel_centres = np.arange(side_px) + 0.5
    position = np.clip(pixel_centres * cells_per_px - 0.5, 0, last)
    before = position.astype(np.intp)
    after = np.minimum(before + 1, last)
    weight = (position - before).astype(np.float32)
    return _Neighbours(before, after, weight)


def _resize(image: RgbImage, width: int, height: int) -> RgbImage:
    image_height, image_width = image.shape[:2]
    if (height, width) == (image_height, image_width):
        return image
    shrinks = width < image_width or height < image_height
    method = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    resized = cv2.resize(image, (width, height), interpolation=method)
    return resized.astype(np.uint8, copy=False)
