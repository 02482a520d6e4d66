"""Proportions of an image, from its vehicles: whether its width and height have different scales.

Boxes cannot tell: the detector draws a car's proportions into a stretched image, too. The verifier can. Its chips are
cut twice, with the image's width reduced and enlarged by a factor of 1.4. In an image of true proportions neither suits
cars better.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.detection.verifier import CHIP_LENGTH_PX, surroundings
from vehanchor.imagery.tiles import read_around

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.detection.verifier import Verifier
    from vehanchor.imagery.raster import Raster

LEAST_VEHICLES = 5
_MOST_VEHICLES = 32  # the most certain ones; more do not change the result
_FACTOR = 1.4  # an error of 18 % in each direction
_REACH = 2.4  # vehicle lengths from the centre to the farthest pixel that a stretched chip needs
_MOST_LOGIT = 6.0  # limits the weight of one vehicle
_SD_OF_ONE = 0.7  # least standard deviation of the preferences of single vehicles
_SD_OF_PLACES = 0.55  # of the mean preference between images of true proportions, train split


def stretch_sigmas(raster: Raster, boxes: NDArray[np.float64], verifier: Verifier) -> float | None:
    """Compute how surely the vehicles prefer a narrower or a wider image.

    Args:
        raster: the image.
        boxes: ``[n, 5]`` rows ``(x, y, length, width, angle)`` of the detector's vehicles in image pixels, centred
            inside the image, best first.
        verifier: scores their chips.

    Returns:
        Mean difference of the logits over its standard deviation: above 0 if the image is too wide, below 0 if it is
        too high; None for fewer than five vehicles.
    """
    if len(boxes) < LEAST_VEHICLES:
        return None
    chosen = boxes[:_MOST_VEHICLES]
    narrower, wider = (
        np.clip(verifier.logits(_chips(raster, chosen, width)), -_MOST_LOGIT, _MOST_LOGIT)
        for width in (1 / _FACTOR, _FACTOR)
    )
    gains = narrower - wider
    variance = (float(gains.var(ddof=1)) + _SD_OF_ONE**2) / len(gains) + _SD_OF_PLACES**2
    return float(gains.mean()) / math.sqrt(variance)


def _chips(raster: Raster, boxes: NDArray[np.float64], width: float) -> NDArray[np.uint8]:
    """Cut chips ``[n, 48, 48, 3]`` from the image with its width multiplied by a factor.

    The detector keeps a stretched car's area and gives its box the usual proportions.
    """
    chips = []
    for box in boxes:
        factor = 2 ** max(0, math.floor(math.log2(box[2] / (2 * CHIP_LENGTH_PX))))
        pixels, (x, y, length, breadth, angle) = read_around(raster, box, factor, _REACH)
        columns = max(1, round(pixels.shape[1] * width))
        across = columns / pixels.shape[1]
        method = cv2.INTER_AREA if across < 1 else cv2.INTER_LINEAR
        resized = np.asarray(cv2.resize(pixels, (columns, pixels.shape[0]), interpolation=method), np.uint8)
        turned = math.atan2(math.sin(angle), math.cos(angle) * across)
        size = math.sqrt(across)
        chips.append(surroundings(resized, [[x * across, y, length * size, breadth * size, turned]])[0])
    return np.stack(chips)
