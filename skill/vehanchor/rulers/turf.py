"""Smooth coloured ground, such as turf and clay: where pitches may lie."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_WINDOW_M = 8.0  # over which the ground is smooth
_MOST_SD = 10.0  # of its grey levels
_DARKEST, _PALEST = 35, 190  # grey levels
_LEAST_COLOUR = 8  # green over blue: turf, hay and clay; asphalt, concrete and water have less
_HALF_M, _LONG_M = 5.0, 35.0  # least half width and length of the ground
_AROUND_M = 8.0


def smooth_ground(rgb: NDArray[np.uint8], m_per_px: float) -> NDArray[np.uint8]:
    """Find coherent smooth ground that is at least as long as a penalty area is wide.

    Args:
        rgb: the image ``[h, w, 3]``, at about 0.3 m/px.
        m_per_px: its scale, roughly; a coarser one finds more.

    Returns:
        The mask ``[h, w]``, 1 on such ground and around it.
    """
    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    plain = cv2.erode(cv2.morphologyEx(grey, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)), np.ones((3, 3), np.uint8))
    level = plain.astype(np.float32)  # without thin bright lines
    side = max(3, round(_WINDOW_M / m_per_px) | 1)
    mean = cv2.blur(level, (side, side))
    variance = cv2.blur(level * level, (side, side)) - mean * mean
    _, green, blue = cv2.split(cv2.blur(rgb, (side, side)))
    smooth = (variance < _MOST_SD**2) & (mean > _DARKEST) & (mean < _PALEST)
    smooth &= cv2.subtract(green, blue) >= _LEAST_COLOUR
    half = max(1, round(_HALF_M / m_per_px))
    core = cv2.erode(smooth.astype(np.uint8), _disc(half), borderValue=0)
    _, parts, boxes, _ = cv2.connectedComponentsWithStats(core)
    long = np.maximum(boxes[:, cv2.CC_STAT_WIDTH], boxes[:, cv2.CC_STAT_HEIGHT]) + 2 * half >= _LONG_M / m_per_px
    long[0] = False  # the background
    return np.asarray(cv2.dilate(long[parts].astype(np.uint8), _disc(half + round(_AROUND_M / m_per_px))), np.uint8)


def _disc(radius: int) -> NDArray[np.uint8]:
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1)), np.uint8)
