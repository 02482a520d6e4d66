"""Proportions of an image, from its vehicles: whether its width and height have different scales.

The detector's boxes do not show this: the detector draws a car's usual proportions into a stretched
image, too. The networks that score the boxes do. Their chips are cut from the image as it is, and
with its width reduced and enlarged by a factor of 1.4. In an image of true proportions, neither
suits cars better. The detail along rows and columns is a second witness.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.detection import chips, verifier
from vehanchor.detection.verifier import surroundings
from vehanchor.imagery.tiles import read_around
from vehanchor.scale.reliability import NO_DETAIL, normal_density

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.detection.boxes import Boxes
    from vehanchor.detection.chips import ChipNetwork
    from vehanchor.detection.detector_errors import StretchLimits, StretchOdds
    from vehanchor.detection.verifier import Verifier
    from vehanchor.imagery.raster import Raster
    from vehanchor.scale.reliability import ProportionLikelihoods

    Box: TypeAlias = NDArray[np.float64]
    """``[5]`` row ``(x, y, length, width, angle)``."""

    Logits: TypeAlias = NDArray[np.float64]
    """``[n]`` log odds that chips show cars."""

    Chips: TypeAlias = NDArray[np.uint8]
    """``[n, side, side, 3]`` RGB."""

# The image's width is multiplied and divided by it, an error of 18 % in each direction.
_FACTOR = 1.4
# Halves of a chip's diagonal from the centre to the farthest pixel that a stretched chip needs.
_REACH = 1.4
# Largest absolute logit: it limits the weight of one vehicle.
_MAX_LOGIT = 6.0

# Vehicles that the verifier judges, by falling score; more do not change the result.
_MIN_VEHICLES = 5
_MAX_VEHICLES = 32

# Vehicles that the chip network judges if they are few.
_MIN_OF_FEW = 2
_MAX_OF_FEW = 5
# Best vehicles that give the odds of a stretch, and views of each: as in the fit of the odds.
_MAX_OF_ODDS = 8
_VIEWS_OF_ODDS = 2
# Log odds of a car from which a vehicle counts half; a choice.
_EVEN_CAR_LOGIT = 1.0
# Density of a preference that fits neither direction, which bounds the odds.
_LEAST_DENSITY = 1e-6

# Mean resultant length of the doubled headings from which vehicles count as parallel.
_PARALLEL = 0.75


def stretch(raster: Raster, boxes: Boxes, network: Verifier, limits: StretchLimits) -> float | None:
    """Compute how clearly the vehicles prefer a narrower or a wider image.

    The measure is the mean difference of the logits over its standard deviation.

    Args:
        raster: the image.
        boxes: ``[n, 5]`` rows ``(x, y, length, width, angle)`` of the detector's vehicles in image
            pixels, centred inside the image, best first.
        network: scores their chips.
        limits: limits of the network's preferences.

    Returns:
        The preference over its limit: above 1 if the image is too wide, below -1 if it is too high;
        None for fewer than five vehicles.
    """
    if len(boxes) < _MIN_VEHICLES:
        return None
    best = boxes[:_MAX_VEHICLES]

    def logits(width: float) -> Logits:
        squares = _chips(raster, best, width, verifier.CHIP_PX, verifier.CHIP_LENGTH_PX)
        return np.clip(network.logits(squares), -_MAX_LOGIT, _MAX_LOGIT)

    gains = logits(1 / _FACTOR) - logits(_FACTOR)
    # Vehicles of one image share a place, whose error more vehicles do not reduce.
    gain_variance = float(gains.var(ddof=1)) + limits.vehicle_sd**2
    variance = gain_variance / len(gains) + limits.image_sd**2
    gain_in_sds = float(gains.mean()) / math.sqrt(variance)
    return gain_in_sds / limits.limit_sds


def stretch_of_few(
    raster: Raster, boxes: Boxes, network: ChipNetwork, limits: StretchLimits
) -> float | None:
    """Compute how clearly a few vehicles prefer a narrower or a wider image, by the chip network.

    If the image is stretched, one of the changed images suits cars better than the image itself and
    than the other one. The measure is the smaller of both differences of the mean logits, where the
    second one counts a third. Parallel vehicles need clearer evidence: they can also be long
    vehicles, or show their flanks.

    Args:
        raster: the image.
        boxes: ``[n, 5]`` bodies of vehicles, as for ``stretch``.
        network: scores their chips.
        limits: limits of the network's preferences.

    Returns:
        The preference over its limit, as for ``stretch``; None for a single vehicle, which shows
        nothing.
    """
    if len(boxes) < _MIN_OF_FEW:
        return None
    best = boxes[:_MAX_OF_FEW]

    def mean_logit(width: float) -> float:
        squares = _chips(raster, best, width, chips.CHIP_COLUMNS, chips.CHIP_LENGTH_PX)
        logits = network.answers(chips.middle(squares)).logit
        limited = np.clip(logits, -_MAX_LOGIT, _MAX_LOGIT)
        return float(limited.mean())

    narrower = mean_logit(1 / _FACTOR)
    same = mean_logit(1.0)
    wider = mean_logit(_FACTOR)
    too_wide = min(narrower - same, (narrower - wider) / 3)
    too_high = min(wider - same, (wider - narrower) / 3)
    preference = max(0.0, too_wide) - max(0.0, too_high)
    # Doubled headings: cars that face each other are parallel, too.
    headings = np.exp(2j * best[:, 4])
    limit = limits.few_crossed_limit
    if abs(headings.mean()) >= _PARALLEL:
        limit = limits.few_parallel_limit
    return preference / limit


def stretch_log_odds(
    raster: Raster,
    boxes: Boxes,
    car_logits: Logits,
    *,
    chip_network: ChipNetwork,
    network: Verifier,
    errors: StretchOdds,
    detail: ProportionLikelihoods = NO_DETAIL,
) -> float | None:
    """Compute the log odds of what is seen in a stretched image over that in a true one.

    Each vehicle has a preference: both networks' logits in a narrower image less those in a wider
    one. A stretched car at an angle looks skewed, which is clear evidence; one along the rows or
    columns only looks longer or shorter, as cars of other models do. Unlike cars, it counts less.

    Args:
        raster: the image.
        boxes: ``[n, 5]`` bodies of vehicles, as for ``stretch``.
        car_logits: ``[m]`` log odds that the first of them are cars, by the chip network.
        chip_network: scores their chips.
        network: scores their smaller chips.
        errors: distribution of preferences in true and in stretched images.
        detail: likelihoods of the image's detail along its rows and columns.

    Returns:
        Below 0 if what is seen contradicts a stretch; None without vehicles.
    """
    n_vehicles = min(len(boxes), len(car_logits), _MAX_OF_ODDS)
    if not n_vehicles:
        return None
    best = boxes[:n_vehicles]

    def logits(width: float) -> Logits:
        squares = _chips(raster, best, width, chips.CHIP_COLUMNS, chips.CHIP_LENGTH_PX)
        answers = chip_network.answers(chips.middle(squares), views=_VIEWS_OF_ODDS)
        small = _chips(raster, best, width, verifier.CHIP_PX, verifier.CHIP_LENGTH_PX)
        by_chips = np.clip(answers.logit, -_MAX_LOGIT, _MAX_LOGIT)
        return by_chips + np.clip(network.logits(small), -_MAX_LOGIT, _MAX_LOGIT)

    # 1 for a vehicle along the rows, -1 for one along the columns.
    along = np.cos(2 * best[:, 4])
    expected = errors.mean + errors.mean_along * along
    surplus = logits(1 / _FACTOR) - logits(_FACTOR) - expected
    sds = errors.vehicle_sd + errors.vehicle_sd_along * along**2
    p_car = 1 / (1 + np.exp(_EVEN_CAR_LOGIT - car_logits[:n_vehicles]))
    weights = p_car / sds**2
    mean = float((weights * surplus).sum() / weights.sum())
    variance = errors.image_sd**2 + 1 / float(weights.sum())

    # An image of true proportions can have vehicles that are no cars; it can be stretched either
    # way, by more or less.
    if_true = (1 - errors.outliers) * normal_density(mean, math.sqrt(variance))
    if_true += errors.outliers * normal_density(mean, errors.outlier_sd)
    stretched_sd = math.sqrt(variance + errors.shift_sd**2)
    too_wide = normal_density(mean - errors.shift, stretched_sd) + _LEAST_DENSITY
    too_high = normal_density(mean + errors.shift, stretched_sd) + _LEAST_DENSITY
    # The detail is another witness of the same direction.
    if_stretched = (too_wide * detail.too_wide + too_high * detail.too_high) / 2
    return math.log(if_stretched) - math.log(if_true * detail.true)


def _chips(raster: Raster, boxes: Boxes, width: float, side_px: int, length_px: float) -> Chips:
    """Cut chips from the image with its width multiplied by a factor.

    Args:
        raster: the image.
        boxes: ``[n, 5]`` boxes in image pixels.
        width: factor of the image's width.
        side_px: rows and columns of a chip.
        length_px: a vehicle's length on its chip.
    """
    squares = []
    reach = _REACH * math.sqrt(0.5) * side_px / length_px
    for box in boxes:
        # The coarsest power of two that leaves twice the chip's detail.
        spare_detail = box[2] / (2 * length_px)
        exponent = math.floor(math.log2(spare_detail))
        factor = 2 ** max(0, exponent)
        pixels, box_there = read_around(raster, box, factor=factor, reach=reach)
        rows, columns = pixels.shape[:2]
        resized_columns = max(1, round(columns * width))
        across = resized_columns / columns
        interpolation = cv2.INTER_LINEAR
        if across < 1:
            interpolation = cv2.INTER_AREA
        resized = cv2.resize(pixels, (resized_columns, rows), interpolation=interpolation)
        square = surroundings(
            np.asarray(resized, np.uint8),
            _box_after_resizing(box_there, across),
            side_px=side_px,
            length_px=length_px,
        )
        squares.append(square[0])
    return np.stack(squares)


def _box_after_resizing(box: Box, across: float) -> list[float]:
    """Predict the detector's box after the image's width has changed by a factor.

    The detector keeps a stretched car's area and gives its box the usual proportions.
    """
    x, y, length, width, angle = box
    turned = math.atan2(math.sin(angle), math.cos(angle) * across)
    size = math.sqrt(across)
    return [x * across, y, length * size, width * size, turned]
