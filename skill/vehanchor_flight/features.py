"""Features that link overlapping photographs: SIFT on a reduced copy."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from vehanchor.imagery.raster import Window
from vehanchor.imagery.tiles import read_reduced_window

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster

_LONG_SIDE_PX = 1100  # of the reduced copy: a quarter of the side for 12 Mpx
_MOST_FEATURES = 1200
_ROWS_A_READ = 256  # of the reduced copy
_CONTRAST = 0.02  # half of SIFT's default: fields and water have little contrast


@dataclass(frozen=True, eq=False)
class Features:
    """Points of a photograph that can be matched in another photograph of the same ground.

    Attributes:
        points: ``[n, 2]`` x, y in pixels of the photograph, the strongest first.
        descriptors: ``[n, 128]`` uint8, RootSIFT: root of the share of each bin, times 255.
        pixel: pixels of the photograph per pixel of the reduced copy, the accuracy of the points.
    """

    points: NDArray[np.float64]
    descriptors: NDArray[np.uint8]
    pixel: float

    def __len__(self) -> int:
        return len(self.points)


def find_features(raster: Raster, long_side_px: int = _LONG_SIDE_PX) -> Features:
    """Find the strongest features of an image.

    Args:
        raster: the image; one strip of it is held in memory at a time.
        long_side_px: longest side of the reduced copy.

    Returns:
        At most 1,200.
    """
    factor = max(1, math.ceil(max(raster.width_px, raster.height_px) / long_side_px))
    width = raster.width_px // factor
    height = raster.height_px // factor
    grey = np.empty((height, width), np.uint8)
    for top in range(0, height, _ROWS_A_READ):
        rows = min(_ROWS_A_READ, height - top)
        strip = read_reduced_window(raster, Window(0, top, width_px=width, height_px=rows), factor)
        grey[top : top + rows] = cv2.cvtColor(strip, cv2.COLOR_RGB2GRAY)
    cv: Any = cv2  # its stubs lack SIFT
    sift = cv.SIFT_create(nfeatures=_MOST_FEATURES, contrastThreshold=_CONTRAST)
    found, described = sift.detectAndCompute(grey, None)
    if not found:
        return Features(np.zeros((0, 2)), np.zeros((0, 128), np.uint8), float(factor))
    order = np.argsort([-point.response for point in found], kind="stable")[:_MOST_FEATURES]
    points = np.array([found[place].pt for place in order], dtype=np.float64)
    raw = np.asarray(described, dtype=np.float64)[order]
    roots = np.sqrt(raw / np.maximum(raw.sum(axis=1, keepdims=True), 1e-9))
    return Features((points + 0.5) * factor, np.rint(255 * roots).astype(np.uint8), float(factor))
