"""Texture of a picture on both sides of a line: one picture goes on behind a line drawn over it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import NDArray

    Columns: TypeAlias = NDArray[np.uint8]
    """``[h, w]`` grey values of neighbouring columns."""

    Line: TypeAlias = NDArray[np.float32]
    """``[h]`` a number for each pixel of a line."""

MIN_COMMON_TEXTURE = 0.2
"""Correlation of both sides from which one picture goes on behind a line.

Strips between 60 pairs of photographs have at most 0.17. Of 120 photographs with a map's grid 25
seem to consist of several pictures, 103 without this limit; of 120 insets 98 are found, 99 without.
"""

# Pixels over which texture is measured.
_TEXTURE_PX = 9


def common_texture(left: Columns, right: Columns) -> float:
    """Correlate the texture of two groups of columns, -1 to 1; 1 without any texture."""
    of_left = _texture(left)
    of_right = _texture(right)
    left_power = float((of_left**2).sum())
    right_power = float((of_right**2).sum())
    power = math.sqrt(left_power * right_power)
    if power == 0.0:
        return 1.0
    return float((of_left * of_right).sum()) / power


def _texture(columns: Columns) -> Line:
    """Average columns, and subtract from each pixel its local mean."""
    line = columns.mean(axis=1, dtype=np.float32)
    local_mean = cv2.blur(line.reshape(-1, 1), (1, _TEXTURE_PX))
    return np.asarray(line - local_mean.ravel())
