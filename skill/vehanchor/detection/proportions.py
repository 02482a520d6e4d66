"""Proportions of an image, from its vehicles: whether its width and height have different scales.

Boxes cannot tell: the detector draws a car's proportions into a stretched image, too. The networks
that score them can. Their chips are cut with the image's width reduced and enlarged by a factor of
1.4. In an image of true proportions neither suits cars better.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.detection import chips, verifier
from vehanchor.detection.verifier import surroundings
from vehanchor.imagery.tiles import read_around

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.detection.chips import ChipNetwork
    from vehanchor.detection.verifier import Verifier
    from vehanchor.imagery.raster import Raster

_LEAST_VEHICLES = 5
_LEAST_VERIFIED = 2
# the most certain ones; more do not change the result
_MOST_VEHICLES = 32
_MOST_VERIFIED = 5
_FACTOR = 1.4  # an error of 18 % in each direction
# halves of a chip's diagonal from the centre to the farthest pixel that a stretched chip needs
_REACH = 1.4
_MOST_LOGIT = 6.0  # limits the weight of one vehicle
_SD_OF_ONE = 0.7  # least standard deviation of the preferences of single vehicles
_SD_OF_PLACES = 0.55  # of the mean preference between images of true proportions, train split
# 0 of 243 images of true proportions have more; 87 of 100 of those stretched by 1.4
_LIMIT_SIGMAS = 2.75
_PARALLEL = 0.75  # least mean resultant length of doubled headings of vehicles that stand alike
# 1 of 172 images of true proportions has more; 176 of 294 stretched by 1.4
_LIMIT_PARALLEL = 0.7
_LIMIT_CROSSED = 0.28


def stretch(raster: Raster, boxes: NDArray[np.float64], network: Verifier) -> float | None:
    """Compute how surely the vehicles prefer a narrower or a wider image.

    The measure is the mean difference of the logits over its standard deviation.

    Args:
        raster: the image.
        boxes: ``[n, 5]`` rows ``(x, y, length, width, angle)`` of the detector's vehicles in image
            pixels, centred inside the image, best first.
        network: scores their chips.

    Returns:
        The preference over its limit: above 1 if the image is too wide, below -1 if it is too high;
        None for fewer than five vehicles.
    """
    if len(boxes) < _LEAST_VEHICLES:
        return None
    chosen = boxes[:_MOST_VEHICLES]
    chip = verifier.CHIP_PX, verifier.CHIP_LENGTH_PX
    narrower, wider = (
        np.clip(network.logits(_chips(raster, chosen, width, *chip)), -_MOST_LOGIT, _MOST_LOGIT)
        for width in (1 / _FACTOR, _FACTOR)
    )
    gains = narrower - wider
    variance = (float(gains.var(ddof=1)) + _SD_OF_ONE**2) / len(gains) + _SD_OF_PLACES**2
    return float(gains.mean()) / math.sqrt(variance) / _LIMIT_SIGMAS


def stretch_of_few(
    raster: Raster, boxes: NDArray[np.float64], network: ChipNetwork
) -> float | None:
    """Compute how surely a few vehicles prefer a narrower or a wider image, by the chip network.

    A stretched image suits cars worse than one of the two others, and better than the other one.
    The measure is the smaller of both differences of the mean logits, where the second one counts a
    third. Parallel vehicles must say it more clearly: they can also be long vehicles, or show their
    flanks.

    Args:
        raster: the image.
        boxes: ``[n, 5]`` bodies of vehicles, as for ``stretch``.
        network: scores their chips.

    Returns:
        The preference over its limit, as for ``stretch``; None for a single vehicle, which can tell
        nothing.
    """
    if len(boxes) < _LEAST_VERIFIED:
        return None
    chosen = boxes[:_MOST_VERIFIED]
    side = chips.CHIP_COLUMNS, chips.CHIP_LENGTH_PX
    narrower, same, wider = (
        float(
            np.clip(network.answers(chips.middle(squares)).logit, -_MOST_LOGIT, _MOST_LOGIT).mean()
        )
        for squares in (
            _chips(raster, chosen, width, *side) for width in (1 / _FACTOR, 1.0, _FACTOR)
        )
    )
    too_wide = max(0.0, min(narrower - same, (narrower - wider) / 3))
    too_high = max(0.0, min(wider - same, (wider - narrower) / 3))
    parallel = abs(np.exp(2j * chosen[:, 4]).mean()) >= _PARALLEL
    return (too_wide - too_high) / (_LIMIT_PARALLEL if parallel else _LIMIT_CROSSED)


def _chips(
    raster: Raster, boxes: NDArray[np.float64], width: float, side_px: int, length_px: float
) -> NDArray[np.uint8]:
    """Cut chips ``[n, side, side, 3]`` from the image with its width multiplied by a factor.

    The detector keeps a stretched car's area and gives its box the usual proportions.
    """
    chips = []
    reach = _REACH * math.sqrt(0.5) * side_px / length_px
    for box in boxes:
        factor = 2 ** max(0, math.floor(math.log2(box[2] / (2 * length_px))))
        pixels, (x, y, length, breadth, angle) = read_around(
            raster, box, factor=factor, reach=reach
        )
        columns = max(1, round(pixels.shape[1] * width))
        across = columns / pixels.shape[1]
        method = cv2.INTER_AREA if across < 1 else cv2.INTER_LINEAR
        resized = np.asarray(
            cv2.resize(pixels, (columns, pixels.shape[0]), interpolation=method), np.uint8
        )
        turned = math.atan2(math.sin(angle), math.cos(angle) * across)
        size = math.sqrt(across)
        moved = [[x * across, y, length * size, breadth * size, turned]]
        chips.append(surroundings(resized, moved, side_px=side_px, length_px=length_px)[0])
    return np.stack(chips)
