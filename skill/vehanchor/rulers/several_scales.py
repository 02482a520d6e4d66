"""Several scales in one image: vehicles of one part imply another scale than those of the rest.

Pictures side by side, collages and insets have no single scale. The vehicles of one part are then
outliers of the fleet, and all of them lie in one rectangle of the image, in which no vehicle of the
fleet lies. A lorry among cars is an outlier, too, but a single one proves nothing, and several
lorries seldom have a rectangle to themselves.

The measure is a log likelihood ratio: how much better two scales explain the vehicles than one,
with the rectangle and the second scale that suit them best.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.detection.boxes import box_corners
from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.detection.detections import Detections
    from vehanchor.detection.detector_errors import DetectorErrors
    from vehanchor.imagery.facts import ImageFacts

    PerVehicle: TypeAlias = NDArray[np.float64]
    """``[n]`` one number for each vehicle."""

    LogScales: TypeAlias = NDArray[np.float64]
    """``[s]`` logs of candidate scales."""

    LogLikelihoods: TypeAlias = NDArray[np.float64]
    """``[s, n]`` for each candidate scale and vehicle."""

_MIN_VEHICLES = 3
# Numbers without a measurement beside them are choices.

# Pixels by which the box of a vehicle that is not cut may lie outside the image.
_BEYOND_BORDER_PX = 1.5
# Least log likelihood ratio. Of 1,061 photographs of known scale that would be usable and right one
# has more; of 100 collages of two scales that differ by 1.3 to 2.5 times, some without cars in one
# part, 32. A choice between both, made on these photographs.
_MIN_LOG_RATIO = 8.5
# Log ratios of the second scale to the first: from 1.2 times, which matters, to 5 times.
_STEP = 0.05
_RATIOS = np.arange(-1.6, 1.6 + _STEP / 2, _STEP)
_SECOND_RATIOS = _RATIOS[np.abs(_RATIOS) >= math.log(1.2)]
# Step and margin of the grid of first scales.
_FIRST_STEP = 0.02
_FIRST_MARGIN = 0.1
# Further spread of the log scale by one vehicle, between parts of one image; choices.
_APPEARANCE_LOG_SD = 0.06
_BOX_LOG_SD = 0.10
# Score of a vehicle, at most and at least, as the chance that it is a car. A car can be a van.
_MAX_P_CAR = 0.97
_MIN_P_CAR = 0.01
# A box that is not a car implies any scale within a factor of e^3.
_OTHER_DENSITY = 1.0 / 3.0
# Rows and columns of cells, with as many vehicles in each, of which rectangles consist.
_CELLS = 12


class _Vehicles(NamedTuple):
    """Scales that vehicles imply.

    Attributes:
        log_scales: ``[n]`` logs of metres per pixel.
        log_sds: ``[n]`` their standard deviations.
        p_car: ``[n]`` chances that they are cars.
    """

    log_scales: PerVehicle
    log_sds: PerVehicle
    p_car: PerVehicle

    def log_likelihoods(self, log_scales: LogScales) -> LogLikelihoods:
        """Compute how well each scale explains each vehicle."""
        deviations = (self.log_scales - log_scales[:, None]) / self.log_sds
        norm = self.log_sds * math.sqrt(2 * math.pi)
        normal = np.exp(-0.5 * deviations**2) / norm
        likelihood = self.p_car * normal + (1.0 - self.p_car) * _OTHER_DENSITY
        return np.asarray(np.log(likelihood))


def several_scales_notice(
    image: ImageFacts, detections: Detections, *, length_m: float, errors: DetectorErrors
) -> tuple[Notice, ...]:
    """Warn of a part of the image in which the vehicles imply another scale.

    Args:
        image: facts of the image; a map with a georeference has one scale.
        detections: vehicles in pixels of the image.
        length_m: length of a car whose appearance is unknown.
        errors: errors of the detector.

    Returns:
        One notice, or none.
    """
    if image.georeference_gsd_m_per_px is not None:
        return ()
    whole = detections.take(_are_whole(detections, image))
    ratio = second_scale(whole, length_m=length_m, errors=errors)
    if ratio is None:
        return ()
    larger = max(ratio, 1.0 / ratio)
    message = (
        "The vehicles in one part of the image imply a scale that differs from the rest by about "
        f"{larger:.2g} times. The image may consist of several pictures, such as a collage or an "
        "inset. Give each picture alone."
    )
    return (Notice(code=NoticeCode.SEVERAL_SCALES, message=message),)


def _are_whole(detections: Detections, image: ImageFacts) -> NDArray[np.bool_]:
    """Mark ``[n]`` the vehicles that the border of the image does not cut: others look shorter."""
    corners = box_corners(detections.boxes)
    most = np.array([image.width_px, image.height_px]) + _BEYOND_BORDER_PX
    are_inside = (corners >= -_BEYOND_BORDER_PX) & (corners <= most)
    return np.asarray(are_inside.all(axis=(1, 2)))


def second_scale(
    detections: Detections, *, length_m: float, errors: DetectorErrors
) -> float | None:
    """Find a second scale that the vehicles of one rectangle of the image share.

    Args:
        detections: vehicles in pixels of the image.
        length_m: length of a car whose appearance is unknown.
        errors: errors of the detector.

    Returns:
        The second scale over the first; None if one scale explains all vehicles nearly as well.
    """
    if len(detections.boxes) < _MIN_VEHICLES:
        return None
    vehicles = _implied_scales(detections, length_m, errors)
    lowest = vehicles.log_scales.min() - _FIRST_MARGIN
    highest = vehicles.log_scales.max() + _FIRST_MARGIN
    candidates = np.arange(lowest, highest, _FIRST_STEP)
    best = vehicles.log_likelihoods(candidates).sum(axis=1).argmax()
    first = candidates[best : best + 1]
    gains = vehicles.log_likelihoods(first + _SECOND_RATIOS) - vehicles.log_likelihoods(first)
    gain, log_ratio = _best_rectangle(detections.boxes[:, :2], gains)
    if gain < _MIN_LOG_RATIO:
        return None
    return math.exp(log_ratio)


def _implied_scales(detections: Detections, length_m: float, errors: DetectorErrors) -> _Vehicles:
    """Compute the scale that each vehicle implies."""
    n_vehicles = len(detections.boxes)
    log_lengths = np.full(n_vehicles, math.log(length_m))
    log_sds = np.full(n_vehicles, math.hypot(errors.boxes.log_sd, _BOX_LOG_SD))
    appearance = detections.appearance
    if appearance is not None:
        # Only the first detections have an appearance.
        n = len(appearance)
        log_lengths[:n] = appearance.log_lengths
        log_sds[:n] = np.hypot(appearance.log_sds, _APPEARANCE_LOG_SD)
    return _Vehicles(
        log_lengths - np.log(detections.boxes[:, 2]),
        log_sds,
        np.clip(detections.scores, _MIN_P_CAR, _MAX_P_CAR),
    )


def _best_rectangle(centres: NDArray[np.float64], gains: LogLikelihoods) -> tuple[float, float]:
    """Find the rectangle and the second scale with the largest sum of gains.

    Args:
        centres: ``[n, 2]`` x, y of the vehicles.
        gains: ``[s, n]`` gain of each vehicle by each second scale.

    Returns:
        The sum, and the log ratio of the second scale to the first.
    """
    column, n_columns = _cell(centres[:, 0])
    row, n_rows = _cell(centres[:, 1])
    # Sums over all cells above and left of a corner, so that four of them give any rectangle.
    sums = np.zeros((len(gains), n_rows + 1, n_columns + 1))
    for k, of_scale in enumerate(gains):
        np.add.at(sums[k, 1:, 1:], (row, column), of_scale)
    sums = sums.cumsum(axis=1).cumsum(axis=2)
    best_gain = 0.0
    best_ratio = 0.0
    for top in range(n_rows):
        for bottom in range(top + 1, n_rows + 1):
            of_rows = sums[:, bottom] - sums[:, top]
            for left in range(n_columns):
                of_rectangles = of_rows[:, left + 1 :] - of_rows[:, left : left + 1]
                gain = float(of_rectangles.max())
                if gain <= best_gain:
                    continue
                best_gain = gain
                scale, _ = np.unravel_index(of_rectangles.argmax(), of_rectangles.shape)
                best_ratio = float(_SECOND_RATIOS[scale])
    return best_gain, best_ratio


def _cell(coordinates: PerVehicle) -> tuple[NDArray[np.intp], int]:
    """Divide a side into cells with as many vehicles in each.

    Returns:
        ``[n]`` the cell of each vehicle, and the number of cells.
    """
    shares = np.linspace(0.0, 1.0, _CELLS + 1)[1:-1]
    borders = np.unique(np.quantile(coordinates, shares))
    return np.searchsorted(borders, coordinates), len(borders) + 1
