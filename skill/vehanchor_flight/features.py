"""Features that link overlapping photographs: SIFT on a reduced copy."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import cv2
import numpy as np

from vehanchor.imagery.raster import Window
from vehanchor.imagery.tiles import read_reduced_window

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster

    Points: TypeAlias = NDArray[np.float64]
    """Points x, y ``[n, 2]`` in pixels."""

    Descriptors: TypeAlias = NDArray[np.uint8]
    """Descriptors ``[n, 128]`` of points."""

    Grey: TypeAlias = NDArray[np.uint8]
    """Grey levels ``[h, w]``."""

_LONG_SIDE_PX = 1100  # Of the reduced copy: a quarter of the side of 12 Mpx.
_MAX_FEATURES = 1200
_STRIP_ROWS = 256  # Rows of the reduced copy that are read at a time.
_CONTRAST = 0.02  # Half of SIFT's default: fields and water have little contrast.


@dataclass(frozen=True, eq=False)
class Features:
    """Points of a photograph that can be matched in another photograph of the same ground.

    Attributes:
        points: ``[n, 2]`` x, y in pixels of the photograph, the strongest first.
        descriptors: ``[n, 128]`` uint8, RootSIFT: root of the share of each bin, times 255.
        pixel: pixels of the photograph per pixel of the reduced copy, the accuracy of the points.
    """

    points: Points
    descriptors: Descriptors
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
    side_px = max(raster.width_px, raster.height_px)
    factor = max(1, math.ceil(side_px / long_side_px))
    grey = _reduced_grey(raster, factor)
    cv: Any = cv2  # The stubs of OpenCV lack SIFT.
    sift = cv.SIFT_create(nfeatures=_MAX_FEATURES, contrastThreshold=_CONTRAST)
    keypoints, sift_descriptors = sift.detectAndCompute(grey, None)
    if not keypoints:
        no_points = np.zeros((0, 2))
        no_descriptors = np.zeros((0, 128), np.uint8)
        return Features(no_points, no_descriptors, float(factor))
    # SIFT can return more than it is asked for: several orientations of one point.
    strengths = np.array([keypoint.response for keypoint in keypoints])
    order = np.argsort(-strengths, kind="stable")[:_MAX_FEATURES]
    strongest = [keypoints[index] for index in order]
    reduced_points = np.array([keypoint.pt for keypoint in strongest], dtype=np.float64)
    # OpenCV counts from the centre of the first pixel, the photograph from its corner.
    points = (reduced_points + 0.5) * factor
    # RootSIFT (Arandjelovic and Zisserman, 2012) matches better than SIFT.
    all_histograms = np.asarray(sift_descriptors, dtype=np.float64)
    histograms = all_histograms[order]
    sums = histograms.sum(axis=1, keepdims=True)
    shares = histograms / np.maximum(sums, 1e-9)
    roots = np.rint(255 * np.sqrt(shares))
    return Features(points, roots.astype(np.uint8), float(factor))


def _reduced_grey(raster: Raster, factor: int) -> Grey:
    """Read a reduced copy of an image in grey levels, strip by strip."""
    width = raster.width_px // factor
    height = raster.height_px // factor
    grey = np.empty((height, width), np.uint8)
    for top in range(0, height, _STRIP_ROWS):
        rows = min(_STRIP_ROWS, height - top)
        window = Window(0, top, width_px=width, height_px=rows)
        strip = read_reduced_window(raster, window, factor)
        bottom = top + rows
        grey[top:bottom] = cv2.cvtColor(strip, cv2.COLOR_RGB2GRAY)
    return grey
