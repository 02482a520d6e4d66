"""Spheres without metadata: pictures of all directions, as frames of 360-degree cameras are.

An equirectangular picture is twice as wide as high. Its left and right borders show the same
direction, and each pixel of its first and last row the same point. Programs that extract frames,
and those that share pictures, leave out the metadata that would say so.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vehanchor.imagery.tiles import read_small_grey

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster

    Grey: TypeAlias = NDArray[np.float32]
    """``[h, w]`` grey values."""

_SIDE_PX = 1024
# Difference of the longer side and twice the shorter one, pixels, as rounding leaves it.
_MAX_DIFFERENCE_PX = 2
# Spread of the grey values in the first and in the last row, and at least that of the picture, from
# which rows without texture mean something. Choices.
_MAX_POLE_SD = 6.0
_MIN_PICTURE_SD = 15.0
# Difference of both borders, relative to that of columns an eighth of the width apart. A choice:
# unrelated columns have about one.
_MAX_SEAM = 0.4
_APART = 8


def is_sphere(raster: Raster) -> bool:
    """Test whether an image is an equirectangular picture of all directions."""
    if abs(raster.width_px - 2 * raster.height_px) > _MAX_DIFFERENCE_PX:
        return False
    small = read_small_grey(raster, _SIDE_PX)
    if small is None:
        return False
    grey = small[0].astype(np.float32)
    has_poles = max(grey[0].std(), grey[-1].std()) <= _MAX_POLE_SD
    if not has_poles or grey.std() < _MIN_PICTURE_SD:
        return False
    step = grey.shape[1] // _APART
    border_difference = _difference(grey[:, 0], grey[:, -1])
    usual_difference = _difference(grey, np.roll(grey, step, axis=1))
    return border_difference <= _MAX_SEAM * usual_difference


def _difference(first: Grey, second: Grey) -> float:
    """Compute the mean difference of two columns, or of all columns of two pictures."""
    return float(np.abs(first - second).mean())
