"""Drawings: pictures that are no photographs, such as pages, charts, maps and programs.

A drawing is flat between its edges, and its edges are sharp. A photograph has noise and texture
everywhere, and soft edges. A photograph of water or snow is flat without sharp edges; one of boats
on dark water comes nearest to a drawing.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from vehanchor.imagery.raster import Window

if TYPE_CHECKING:
    from vehanchor.imagery.raster import Raster, RgbImage

PATCH_PX = 64
"""Side of the patches that are judged."""

# Patches along a side of the image, at even steps.
_MAX_ALONG = 6
# Largest difference of neighbouring pixels (3 x 3, the largest of the bands): in grey levels.
_UNIFORM = 1
_FLAT = 3
_SHARP = 40
# Share of uniform pixels from which a patch shows nothing: plain paper, or the border of a mosaic.
_EMPTY_SHARE = 0.995
# Share of sharp pixels from which a patch shows edges, and share of such patches that is needed.
_EDGE_SHARE = 0.005
_EDGED_PATCHES = 0.1
# Keeps a share of nothing finite.
_MARGIN = 1e-3


class DrawingWeights(NamedTuple):
    """Logistic regression of a drawing on medians over the patches with edges.

    Attributes:
        flat: weight of the share of flat pixels.
        sharp: weight of the share of sharp pixels among those that are not uniform.
        both: weight of the product of both shares.
        offset: log odds without either.
    """

    flat: float
    sharp: float
    both: float
    offset: float


# Fitted to 1,214 photographs and rendered scenes, and 210 drawings (research.scenes.pages), in
# equal parts; 6 is then taken from the offset, because few pictures are drawings. Of 1,905
# photographs of known scale the highest chance is 0.43 (boats on dark water), and 23 have more than
# 0.01.
_WEIGHTS = DrawingWeights(flat=14.9, sharp=6.4, both=12.0, offset=-12.6)


def measure_drawing_chance(raster: Raster) -> float:
    """Measure the chance, 0..1, that an image is drawn and no photograph.

    Args:
        raster: the image.

    Returns:
        The chance; 0 if a side is below 64 px, or if less than a tenth of it shows sharp edges.
    """
    if min(raster.width_px, raster.height_px) < PATCH_PX:
        return 0.0
    columns = _starts(raster.width_px)
    rows = _starts(raster.height_px)
    flat_shares = []
    edged_shares = []
    for y in rows:
        for x in columns:
            patch = raster.read(Window(x, y, width_px=PATCH_PX, height_px=PATCH_PX))
            uniform, flat, sharp = _difference_shares(patch)
            if uniform >= _EMPTY_SHARE:
                continue
            flat_shares.append(flat)
            if sharp > _EDGE_SHARE:
                edged_shares.append((flat, sharp / (1 - uniform + _MARGIN)))
    if len(edged_shares) < max(1.0, _EDGED_PATCHES * len(flat_shares)):
        return 0.0
    flat_beside_edges, sharp = np.median(edged_shares, axis=0)
    # A flat thing with sharp edges, such as a pool, does not make a drawing of a photograph.
    flat = min(flat_beside_edges, np.median(flat_shares))
    log_odds = (
        _WEIGHTS.flat * flat
        + _WEIGHTS.sharp * sharp
        + _WEIGHTS.both * flat * sharp
        + _WEIGHTS.offset
    )
    # The logistic function, by a formula that does not overflow.
    return (1.0 + math.tanh(log_odds / 2)) / 2


def _starts(side_px: int) -> list[int]:
    """Choose the first pixels of patches along a side, at even steps."""
    count = min(_MAX_ALONG, side_px // PATCH_PX)
    starts: list[int] = np.linspace(0, side_px - PATCH_PX, count).astype(int).tolist()
    return starts


def _difference_shares(patch: RgbImage) -> tuple[float, float, float]:
    """Compute the shares of pixels that are uniform, flat and sharp among their neighbours."""
    neighbours = np.ones((3, 3), np.uint8)
    highest = cv2.dilate(patch, neighbours)
    lowest = cv2.erode(patch, neighbours)
    difference = cv2.subtract(highest, lowest).max(axis=2)
    uniform = float(np.mean(difference <= _UNIFORM))
    flat = float(np.mean(difference <= _FLAT))
    sharp = float(np.mean(difference > _SHARP))
    return uniform, flat, sharp
