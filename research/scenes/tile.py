"""Tile: one window of the canvas, with its pixels and conversion from metres."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from research.scenes.raster import clip_polygon
from research.scenes.world import Rgb

Points: TypeAlias = NDArray[np.float64]
"""Points x, y ``[n, 2]``."""

_Layer = NDArray[np.float32]
_Pixels = NDArray[np.uint8]

SUBPIXEL_BITS = 4
# Polygons that reach farther beyond a tile are clipped: OpenCV's coordinates are finite.
_FAR_PX = 6000.0


@dataclass(eq=False)
class Tile:
    """Window of the canvas from (x, y) on, at ``step`` metres per pixel."""

    x: float
    y: float
    step: float
    width: int
    height: int
    rgb: _Pixels
    crowns: _Pixels
    noise: tuple[_Layer, _Layer, _Layer]

    def pixels(self, points: Points) -> Points:
        """Convert metres to the tile's continuous pixel coordinates."""
        return (points - (self.x, self.y)) / self.step

    def window(self, low: Points, high: Points) -> tuple[int, int, int, int] | None:
        """Compute the pixels x0, y0, x1, y1 that a box in pixels touches; None for none."""
        x0 = max(math.floor(low[0]), 0)
        y0 = max(math.floor(low[1]), 0)
        x1 = min(math.ceil(high[0]), self.width)
        y1 = min(math.ceil(high[1]), self.height)
        return (x0, y0, x1, y1) if x0 < x1 and y0 < y1 else None

    def fixed(self, points: Points) -> NDArray[np.int32] | None:
        """Convert metres to OpenCV's fixed-point coordinates; None if out of reach.

        Integers are pixel centres.
        """
        pixels = self.pixels(points)
        if np.abs(pixels).max() > _FAR_PX:
            pixels = clip_polygon(pixels, -16, y0=-16, x1=self.width + 16, y1=self.height + 16)
            if len(pixels) < 3:
                return None
        return cast(
            "NDArray[np.int32]", np.rint((pixels - 0.5) * 2**SUBPIXEL_BITS).astype(np.int32)
        )

    def fill(self, image: _Pixels, points: Points, value: int | Rgb) -> None:
        """Fill an outline, given in metres, in an image of the tile's size."""
        outline = self.fixed(points)
        if outline is not None:
            cv2.fillPoly(image, [outline], value, cv2.LINE_AA, SUBPIXEL_BITS)
