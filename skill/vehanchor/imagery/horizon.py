"""Horizon: a straight border between a smooth bright sky and the ground below it.

A photograph with the horizon was taken far from nadir, and no scale holds for all of it. The sky is
smooth and brighter than the ground, and haze takes contrast from the ground below it. Calm water at
the upper side of a nadir photograph is smooth, too, but it is dark, and a shore has full contrast.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import cv2
import numpy as np

from vehanchor.imagery.tiles import read_small_grey

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster

    Plane: TypeAlias = NDArray[np.float32]
    """``[h, w]`` grey values, or differences of them."""

    Rows: TypeAlias = NDArray[np.float64]
    """``[w]`` rows, one for each column."""

# Numbers without a measurement beside them are choices.

# Longest side of the reduced image in which the horizon is looked for.
_SIDE_PX = 256
_MIN_SIDE_PX = 40
# Slope of grey values per pixel above which there is something; a sky has less.
_MIN_SLOPE = 4.0
# Constant rows are a margin, and no sky: their noise is below this standard deviation.
_MARGIN_SD = 0.3
# Rows on both sides of the border that belong to neither side.
_GAP_PX = 3
# Largest distance from the line and least share of the columns that are nearer, as shares of the
# height and of the columns.
_REACH = 0.03
_MIN_SHARE = 0.9
# Grey levels by which the sky is brighter than the ground.
_MIN_BRIGHTER = 15.0
# Largest contrast of the ground below the horizon over that of the lower half of it.
_MAX_CONTRAST = 1.5
# Least height of the sky, and of the ground, as shares of the height.
_MIN_SKY = 0.03
_MIN_GROUND = 0.2
# Height of the strip of ground below the horizon, as a share of the height.
_STRIP = 0.1
_N_STEPS = 10
# The limits were chosen on half of some 2,700 photographs that show no sky, in all of which they
# find a horizon once: in the one photograph that has one. In rendered oblique views of the same
# ground with 5 % and more of sky they find it in 29 of 34; not found are skies darker than the
# ground, and clouds with sharp edges.


def find_horizon(raster: Raster) -> int | None:
    """Find the horizon of an image.

    Args:
        raster: the image.

    Returns:
        Its row in the middle of the image; None without one, or if the image is too large.
    """
    small = read_small_grey(raster, _SIDE_PX)
    if small is None:
        return None
    grey, factor = small
    if min(grey.shape) < _MIN_SIDE_PX:
        return None
    row = _horizon(grey.astype(np.float32))
    return None if row is None else round(row * factor)


def _horizon(grey: Plane) -> float | None:
    """Find the row of the horizon in the middle of a small image; None without one."""
    height, width = grey.shape
    slopes = _slopes(grey)
    is_busy = slopes > _MIN_SLOPE
    first_rows = np.where(is_busy.any(axis=0), is_busy.argmax(axis=0), height)
    line = _fitted_line(first_rows.astype(np.float64))
    near = np.abs(line - first_rows) <= _REACH * height
    middle = float(line[width // 2])
    if near.mean() < _MIN_SHARE or not _MIN_SKY <= middle / height <= 1 - _MIN_GROUND:
        return None

    rows = np.arange(height)[:, None]
    sky = rows < line - _GAP_PX
    ground = rows > line + _GAP_PX
    if not sky.any() or grey[sky].std() < _MARGIN_SD:
        return None
    if grey[sky].mean() < grey[ground].mean() + _MIN_BRIGHTER:
        return None
    # In nadir photographs, what lies beside a bright smooth surface has its full contrast.
    strip = ground & (rows < line + _STRIP * height)
    lower_half = rows > line + (height - line) / 2
    if not strip.any():
        return None
    full_contrast = slopes[lower_half].mean()
    if slopes[strip].mean() > _MAX_CONTRAST * full_contrast:
        return None
    return middle


def _slopes(grey: Plane) -> Plane:
    """Compute the slopes of grey values per pixel, averaged over their neighbours."""
    across = cv2.Sobel(grey, cv2.CV_32F, 1, 0, ksize=3)
    down = cv2.Sobel(grey, cv2.CV_32F, 0, 1, ksize=3)
    # The weights of the kernel add up to eight.
    slopes = np.hypot(across, down) / 8
    return np.asarray(cv2.blur(slopes, (3, 3)))


def _fitted_line(rows: Rows) -> Rows:
    """Fit a straight line to the rows ``[w]`` of columns; few others have little weight."""
    width = len(rows)
    design = np.column_stack([np.arange(width), np.ones(width)])
    line = np.full(width, np.median(rows))
    for _ in range(_N_STEPS):
        weights = 1.0 / (1.0 + ((line - rows) / _GAP_PX) ** 2)
        weighted = design * weights[:, None]
        coefficients, *_ = np.linalg.lstsq(weighted, rows * weights, rcond=None)
        line = design @ coefficients
    return line
