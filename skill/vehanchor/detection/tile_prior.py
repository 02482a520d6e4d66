"""Tile prior: where cars are likely in a large image, from the edges in a preview of it.

Streets, yards and towns have many edges, fields have few.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.imagery.raster import Window
from vehanchor.imagery.tiles import read_preview

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster

CELL_PX = 512
"""Side of the cells of a tile-prior map, pixels of the image."""

_FACTOR = 8  # reduction factor of the preview
_CELL = CELL_PX // _FACTOR
_BLOCK = 4 * _CELL  # pixels of the preview that are read at once: 2048 px of the image
_ODDS_AT_ONE, _ODDS_PER_LOG = -7.2, 3.08  # of a car, over the log gradient: research/training/tile_prior/fit.py
FLAT = 0.5
"""Grey levels per pixel, the gradient of noise, added before the log is taken."""


def gradient(coarse: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Compute the gradient of the grey levels at each pixel.

    Args:
        coarse: ``[h, w, 3]`` uint8 RGB.

    Returns:
        ``[h, w]`` grey levels per pixel.
    """
    grey = cv2.cvtColor(coarse, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return np.asarray(np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)) / 8, np.float32)


def car_prior(coarse: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Compute the probability of cars in each cell of a preview from its mean gradient.

    Args:
        coarse: ``[h, w, 3]`` uint8 RGB at an eighth of the image's resolution.

    Returns:
        ``[ceil(h / 64), ceil(w / 64)]`` in 0..1.
    """
    change = gradient(coarse)
    tops, lefts = range(0, change.shape[0], _CELL), range(0, change.shape[1], _CELL)
    means = np.array([[change[y : y + _CELL, x : x + _CELL].mean() for x in lefts] for y in tops], dtype=np.float64)
    return np.asarray(1 / (1 + np.exp(-(_ODDS_AT_ONE + _ODDS_PER_LOG * np.log(means + FLAT)))))


def tile_prior_map(raster: Raster) -> NDArray[np.float64]:
    """Compute the probability of cars in each cell of an image.

    Args:
        raster: the image; at most 2048 x 2048 px of it are in memory.

    Returns:
        ``[rows, columns]`` of cells of 512 px in 0..1; one cell of 0 for an image with a side below 8 px.
    """
    width, height = raster.width_px // _FACTOR, raster.height_px // _FACTOR
    if not width or not height:
        return np.zeros((1, 1))
    rows = []
    for top in range(0, height, _BLOCK):
        parts = []
        for left in range(0, width, _BLOCK):
            window = Window(left, top, min(_BLOCK, width - left), min(_BLOCK, height - top))
            parts.append(car_prior(read_preview(raster, window, _FACTOR)))
        rows.append(np.concatenate(parts, axis=1))
    return np.concatenate(rows)


def tile_prior_of(cells: NDArray[np.float64], window: Window, factor: int) -> float:
    """Average the cells that a tile touches.

    Args:
        cells: result of ``tile_prior_map``.
        window: the tile, in pixels of the image reduced by ``factor``.
        factor: reduction factor of the tile's level.
    """
    rows, columns = cells.shape
    top, left = min(window.y_px * factor // CELL_PX, rows - 1), min(window.x_px * factor // CELL_PX, columns - 1)
    bottom = -(-(window.y_px + window.height_px) * factor // CELL_PX)
    right = -(-(window.x_px + window.width_px) * factor // CELL_PX)
    return float(cells[top : max(bottom, top + 1), left : max(right, left + 1)].mean())
