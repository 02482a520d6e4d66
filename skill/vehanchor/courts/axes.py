"""Main directions of the edges in a patch; a court's lines, fence and slab are at right angles."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_QUARTER = math.pi / 2
_BINS = 45  # of a quarter turn: 2 degrees each
_SMOOTH_PX = 1.2  # the pixel steps of a thin line have spurious directions
_SUPPORT_PX = 8  # rows that affect the smoothed edges of a row, with a margin
_CLEAREST = 160.0  # in Scharr sums, about ten grey levels: one shadow's edge must not outweigh all painted lines
_NO_EDGE = 0.7  # share of the patch that is texture and noise; rounded grey levels have spurious directions
_SECOND = 0.8  # share of the strongest direction that a second one needs
_APART_BINS = 5


def axes(grey: NDArray[np.float32], x: float, y: float, radius: float) -> list[float]:
    """Find the possible orientations of a rectangle of lines from the gradients around a point.

    Args:
        grey: ``[h, w]`` grey levels.
        x: column of the point (0 is the centre of the first pixel).
        y: row of the point.
        radius: radius of the neighbourhood, pixels.

    Returns:
        One or two angles, radians from 0 to a quarter turn, the strongest first; each includes its perpendicular.
    """
    across, down = _gradients(grey, x, y, radius)
    steepness = np.hypot(across, down)
    clear = steepness > np.quantile(steepness, _NO_EDGE)
    weights = np.minimum(steepness[clear], _CLEAREST)
    turned = np.arctan2(down[clear], across[clear]) % _QUARTER
    cells = (turned / _QUARTER * _BINS).astype(np.intp) % _BINS
    counts = np.bincount(cells, weights, _BINS)
    smooth = (np.roll(counts, 1) + 2 * counts + np.roll(counts, -1)) / 4
    found: list[float] = []
    left = smooth.copy()
    while len(found) < 2:
        peak = int(left.argmax())
        if found and left[peak] < _SECOND * smooth.max():
            break
        before, top, after = smooth[peak - 1], smooth[peak], smooth[(peak + 1) % _BINS]
        bend = before - 2 * top + after
        shift = (before - after) / (2 * bend) if bend < 0 else 0.0
        found.append((peak + 0.5 + shift) * _QUARTER / _BINS)
        left[(peak + np.arange(-_APART_BINS, _APART_BINS + 1)) % _BINS] = 0.0
    return found


def _gradients(
    grey: NDArray[np.float32], x: float, y: float, radius: float
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Compute horizontal and vertical Scharr gradients within a radius of a point; only nearby rows are smoothed."""
    top, left = max(math.floor(y - radius), 0), max(math.floor(x - radius), 0)
    bottom, right = min(math.ceil(y + radius) + 1, grey.shape[0]), min(math.ceil(x + radius) + 1, grey.shape[1])
    first = max(top - _SUPPORT_PX, 0)
    smoothed = cv2.GaussianBlur(grey[first : bottom + _SUPPORT_PX], (0, 0), _SMOOTH_PX)
    rows, columns = np.ogrid[top:bottom, left:right]
    near = (columns - x) ** 2 + (rows - y) ** 2 < radius**2
    box = slice(top - first, bottom - first), slice(left, right)
    across, down = cv2.Scharr(smoothed, cv2.CV_32F, 1, 0), cv2.Scharr(smoothed, cv2.CV_32F, 0, 1)
    return np.asarray(across[box][near], np.float32), np.asarray(down[box][near], np.float32)
