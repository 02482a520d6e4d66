"""Notices about vehicles: doubts that they are cars of true proportions, and lost detail."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.records.text import count

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import ArrayLike, NDArray

    from vehanchor.detection.detections import Appearance, Detections
    from vehanchor.detection.detector_errors import LookAlikeLimits
    from vehanchor.rulers.fleet import Fleet

    Notices: TypeAlias = tuple[Notice, ...]

# Interquartile range of a normal distribution, in standard deviations.
_QUARTILES_PER_SD = 1.349


_STRETCHED = Notice(
    code=NoticeCode.STRETCHED,
    message=(
        "The vehicles would have a car's proportions only if the image were narrower or wider. It "
        "was stretched in one direction or taken at a tilt, so that its width and height have "
        "different scales."
    ),
)
_LOOK_ALIKES = Notice(
    code=NoticeCode.LOOK_ALIKES,
    message=(
        "The vehicles are more alike than cars of different makes, or unlike any known car. They "
        "may be lorries, caravans or containers of one model, roof units or boats. The scale is "
        "then wrong by the ratio of their length to a car's."
    ),
)
DOUBT_CODES = (_STRETCHED.code, _LOOK_ALIKES.code)
"""Codes of the notices that ``doubts`` returns."""


def added_outliers(fleet: Fleet) -> Notices:
    """Warn of vehicles that the caller added, and whose lengths do not fit the fleet."""
    outliers = fleet.detections.stated & ~fleet.kept
    if not outliers.any():
        return ()
    outlier_lengths = fleet.detections.boxes[outliers, 2]
    ratio = float(np.median(outlier_lengths) / np.median(fleet.lengths))
    cause = "a lorry?" if ratio > 1 else "only a part of one?"
    message = (
        f"A vehicle that you added is {ratio:.1f} times as long as the {fleet.kept.sum()} others: "
        f"{cause} It does not count. If the others are not cars, drop them."
    )
    return (Notice(code=NoticeCode.ADDED_VEHICLE_UNLIKE, message=message),)


def doubts(fleet: Fleet, stretch: float | None, limits: LookAlikeLimits) -> Notices:
    """Doubt that the vehicles are cars of true proportions, after a search over scales.

    Without such a search, the vehicles were not chosen by their length, and no doubt arises. A
    caller who states that most of the vehicles are cars resolves the doubt that they are
    look-alikes.

    Args:
        fleet: the vehicles.
        stretch: see ``vehanchor.detection.detections.Detections``; None if it is not doubted.
        limits: the detector's limits of look-alikes.
    """
    if fleet.detections.reductions is None:
        return ()
    notices = []
    if stretch is not None and abs(stretch) > 1.0:
        notices.append(_STRETCHED)
    if fleet.is_stated:
        return tuple(notices)
    if look_alikes(fleet.lengths, fleet.appearance, limits):
        notices.append(_LOOK_ALIKES)
    return tuple(notices)


def look_alikes(lengths: ArrayLike, appearance: Appearance | None, limits: LookAlikeLimits) -> bool:
    """Test whether vehicles may be equal things, such as lorries, caravans or boats in rows.

    One of two signs is enough. Either their lengths and their appearances spread less than those of
    cars of different makes (interquartile range over 1.349), or they look less like cars than any
    fleet.

    Args:
        lengths: ``[n]`` pixels.
        appearance: appearance of the vehicles that have any; None without a chip network.
        limits: the detector's limits, among them the least number of vehicles.
    """
    lengths_px = np.asarray(lengths, dtype=np.float64)
    if len(lengths_px) < limits.min_vehicles:
        return False
    log_lengths = np.log(lengths_px)
    equal_lengths = _spread(log_lengths) < limits.log_sd
    if appearance is None or len(appearance) < limits.min_vehicles:
        return equal_lengths
    if appearance.logits.mean() < limits.min_mean_logit:
        return True
    return equal_lengths and _spread(appearance.log_lengths) < limits.log_sd


def _spread(values: NDArray[np.float64]) -> float:
    """Estimate the standard deviation by the quartiles, which outliers hardly move."""
    low, high = np.percentile(values, [25, 75])
    return float(high - low) / _QUARTILES_PER_SD


def capped_tiles(detections: Detections) -> Notices:
    """Warn of tiles in which the model returned its largest number of boxes."""
    if not detections.n_capped_tiles:
        return ()
    message = (
        f"{detections.n_capped_tiles} of {detections.n_tiles} tiles reached the model's largest "
        "number of boxes: vehicles may be missing. Export the model without nms=True, or use "
        "smaller tiles."
    )
    return (Notice(code=NoticeCode.DETECTIONS_CAPPED, message=message),)


def copied_vehicles(detections: Detections) -> Notices:
    """Warn of vehicles that were left out as copies of others."""
    if not detections.n_copies:
        return ()
    message = (
        f"{count(detections.n_copies, 'vehicle')} repeat the pixels of another one, as if pasted: "
        "each vehicle counts once."
    )
    return (Notice(code=NoticeCode.VEHICLES_COPIED, message=message),)


def detail_missing(length_px: float, guard_px: float, detail_share: float) -> Notices:
    """Warn of vehicles that have enough pixels, but not enough detail.

    Args:
        length_px: modal length in pixels of the copy that the model saw.
        guard_px: ``P_thresh`` of the resolution guard.
        detail_share: share of the pixels' resolution at which there is detail.
    """
    detailed_px = length_px * detail_share
    if length_px < guard_px or detailed_px >= guard_px:
        return ()
    finest_px = 1 / detail_share
    message = (
        f"The image has no detail finer than {finest_px:.2g} px, perhaps because it was enlarged "
        f"or blurred: vehicles of {length_px:.1f} px have the detail of {detailed_px:.1f} px, and "
        f"{guard_px:.1f} px are needed. Give the original image."
    )
    return (Notice(code=NoticeCode.DETAIL_MISSING, message=message),)
