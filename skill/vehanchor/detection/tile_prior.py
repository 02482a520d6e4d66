"""Tile prior: the probability that a part of an image shows cars, from the edges in a preview.

Towns have many edges, fields have few. The search visits tiles with many edges first.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.imagery.raster import Window
from vehanchor.imagery.tiles import read_preview
from vehanchor.odds import chances_of

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.detection.detector_errors import TilePriorOdds
    from vehanchor.imagery.raster import Raster

    Preview: TypeAlias = NDArray[np.uint8]
    """``[h, w, 3]`` RGB at an eighth of the image's resolution."""

    Gradients: TypeAlias = NDArray[np.float32]
    """``[h, w]`` grey levels per pixel."""

    Chances: TypeAlias = NDArray[np.float64]
    """``[rows, columns]`` of cells, probability of cars in 0..1."""

CELL_PX = 512
"""Side of the cells of a tile-prior map, pixels of the image."""

_PREVIEW_FACTOR = 8
# Side of a cell in pixels of the preview.
_PREVIEW_CELL_PX = CELL_PX // _PREVIEW_FACTOR
# Side of the blocks in which the preview is read, pixels of it: 2048 px of the image.
_BLOCK_PX = 4 * _PREVIEW_CELL_PX

NOISE_GRADIENT = 0.5
"""Gradient of noise, grey levels per pixel; it is added to gradients before their log."""


def gradient(coarse: Preview) -> Gradients:
    """Compute the gradient of the grey levels at each pixel.

    Args:
        coarse: ``[h, w, 3]`` uint8 RGB.

    Returns:
        ``[h, w]`` grey levels per pixel.
    """
    grey = cv2.cvtColor(coarse, cv2.COLOR_RGB2GRAY)
    levels = grey.astype(np.float32)
    across = cv2.Sobel(levels, cv2.CV_32F, 1, 0)
    down = cv2.Sobel(levels, cv2.CV_32F, 0, 1)
    # The weights of a Sobel kernel sum to 8 grey levels per pixel.
    slopes = np.hypot(across, down) / 8
    return np.asarray(slopes, np.float32)


def car_prior(coarse: Preview, odds: TilePriorOdds) -> Chances:
    """Compute the probability of cars in each cell of a preview from its mean gradient.

    Args:
        coarse: ``[h, w, 3]`` uint8 RGB at an eighth of the image's resolution.
        odds: odds of cars by the gradient.

    Returns:
        ``[ceil(h / 64), ceil(w / 64)]`` in 0..1.
    """
    side = _PREVIEW_CELL_PX
    slopes = gradient(coarse)
    tops = range(0, slopes.shape[0], side)
    lefts = range(0, slopes.shape[1], side)
    rows = []
    for top in tops:
        band = slopes[top : top + side]
        rows.append([band[:, left : left + side].mean() for left in lefts])
    means = np.array(rows, dtype=np.float64)
    log_gradients = np.log(means + NOISE_GRADIENT)
    log_odds = odds.log_odds_at_one + odds.log_odds_slope * log_gradients
    return chances_of(log_odds)


def tile_prior_map(raster: Raster, odds: TilePriorOdds) -> Chances:
    """Compute the probability of cars in each cell of an image.

    Args:
        raster: the image; at most 2048 x 2048 px of it are in memory.
        odds: odds of cars by the gradient.

    Returns:
        ``[rows, columns]`` of cells of 512 px in 0..1; one cell of 0 for an image with a side below
        8 px.
    """
    width = raster.width_px // _PREVIEW_FACTOR
    height = raster.height_px // _PREVIEW_FACTOR
    if not width or not height:
        return np.zeros((1, 1))
    rows = []
    for top in range(0, height, _BLOCK_PX):
        block_height = min(_BLOCK_PX, height - top)
        blocks = []
        for left in range(0, width, _BLOCK_PX):
            block_width = min(_BLOCK_PX, width - left)
            window = Window(left, top, width_px=block_width, height_px=block_height)
            preview = read_preview(raster, window, _PREVIEW_FACTOR)
            blocks.append(car_prior(preview, odds))
        rows.append(np.concatenate(blocks, axis=1))
    return np.concatenate(rows)


def tile_prior_of(cells: Chances, window: Window, factor: int) -> float:
    """Average the cells that a tile touches.

    Args:
        cells: result of ``tile_prior_map``.
        window: the tile, in pixels of the image reduced by ``factor``.
        factor: reduction factor of the tile's level.
    """
    rows, columns = cells.shape
    right_px = (window.x_px + window.width_px) * factor
    bottom_px = (window.y_px + window.height_px) * factor
    # The preview drops incomplete pixels, so the last cells may end before the image does.
    left = min(window.x_px * factor // CELL_PX, columns - 1)
    top = min(window.y_px * factor // CELL_PX, rows - 1)
    # Rounded up, to include cells that the tile touches in part.
    right = max(math.ceil(right_px / CELL_PX), left + 1)
    bottom = max(math.ceil(bottom_px / CELL_PX), top + 1)
    touched = cells[top:bottom, left:right]
    return float(touched.mean())
