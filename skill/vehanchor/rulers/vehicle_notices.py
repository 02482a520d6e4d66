"""Notices about vehicles: doubts that they are cars of true proportions, and lost detail."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.records.text import count
from vehanchor.scale.defaults import USABLE_CHANCE

if TYPE_CHECKING:
    from typing import TypeAlias

    from vehanchor.detection.detections import Detections
    from vehanchor.rulers.fleet import Fleet
    from vehanchor.rulers.ruler import View

    Notices: TypeAlias = tuple[Notice, ...]

# Chance of look-alikes from which a notice names them: then no scale by vehicles alone is usable.
_NAMED_CHANCE = 1.0 - USABLE_CHANCE

# Detail share below which an image without vehicles counts as enlarged: by two or more. None of 250
# photographs, with and without vehicles, has one below 0.53.
_ENLARGED_SHARE = 0.5
# Patches across and down the image whose detail is measured.
_PATCHES_ACROSS = 4

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
        "may be lorries, caravans or containers of one model, graves, carts or boats. The scale is "
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


def doubts(stretch: float | None, p_look_alikes: float) -> Notices:
    """Doubt that the vehicles are cars of true proportions, after a search over scales.

    Args:
        stretch: see ``vehanchor.detection.detections.Detections``; None if it is not doubted.
        p_look_alikes: chance, 0..1, that the vehicles are look-alikes.
    """
    notices = []
    if stretch is not None and abs(stretch) > 1.0:
        notices.append(_STRETCHED)
    if p_look_alikes > _NAMED_CHANCE:
        notices.append(_LOOK_ALIKES)
    return tuple(notices)


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


def nothing_detailed(view: View) -> Notices:
    """Warn of an image without vehicles that has no detail anywhere, as after enlarging it."""
    shares = (np.arange(_PATCHES_ACROSS) + 0.5) / _PATCHES_ACROSS
    x, y = np.meshgrid(shares * view.image.width_px, shares * view.image.height_px)
    centres = np.column_stack([x.ravel(), y.ravel()])
    detail_share = view.measure_detail_share(centres, 1.0)
    if detail_share >= _ENLARGED_SHARE:
        return ()
    message = (
        f"The image has no detail finer than {1 / detail_share:.2g} px, perhaps because it was "
        "enlarged or blurred. Give the original image."
    )
    return (Notice(code=NoticeCode.DETAIL_MISSING, message=message),)


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
