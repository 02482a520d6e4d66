"""Remedies for models: at most two, the one that helps most first.

Each is given by arguments that every measuring tool has.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.records import AreaMeasurement, GsdEstimate
from vehanchor.scale.defaults import USABLE_CHANCE

if TYPE_CHECKING:
    from pydantic import BaseModel

_MAX_REMEDIES = 2
_REMEDIES = {
    "image": "send the original image",
    "drop": "drop boxes that are not cars, see view_image (drop)",
    "region": "give the region (region)",
    "car": "add a car that has no box (add)",
    "line": "draw a line over {} (known_lengths)",
}
_BESIDE_CARS = "a parking bay or lane dash"
_WITHOUT_CARS = "a container or court"
_ON_STATED = "leave out gsd_m_per_px, and draw a line over something named (known_lengths)"
_ON_CHOICES = "give a tight box drawn by eye around the object that you mean"
_ON_MASK = "look at it with view_image, and give a tight box drawn by eye"


def advice_on(record: BaseModel) -> str:
    """State what would make a record usable; empty for a usable one."""
    if getattr(record, "status", "ok") == "ok":
        return ""
    estimate = record if isinstance(record, GsdEstimate) else getattr(record, "estimate", None)
    if estimate is not None and estimate.status != "ok":
        line = _BESIDE_CARS if estimate.n_vehicles else _WITHOUT_CARS
        names = _remedies(estimate)[:_MAX_REMEDIES]
        return ", or ".join(_REMEDIES[name].format(line) for name in names)
    if isinstance(record, AreaMeasurement):
        confidence = record.scale_confidence
        if confidence is None or confidence >= USABLE_CHANCE:
            return _ON_CHOICES if record.alternatives else _ON_MASK
    return _ON_STATED


def _remedies(estimate: GsdEstimate) -> list[str]:
    """Return names of remedies for a scale that is not usable, the best first."""
    codes = {notice.code for notice in estimate.warnings}
    reason = estimate.reason
    has_vehicles = bool(estimate.n_vehicles)
    # The original helps if this image was reduced too far, or stretched in one direction.
    if reason == "too_coarse" or (reason == "disagree" and "stretched" in codes):
        return ["image", "line"]
    if reason == "no_photograph":
        return ["image", "line"]
    if reason in ("not_cars", "disagree"):
        return ["drop", "line"] if has_vehicles else ["line"]
    # The region helps if the length of the cars is the model's or the looks' estimate.
    is_fleet_unknown = estimate.details.reference_source in ("model", "appearance")
    if has_vehicles and is_fleet_unknown:
        return ["region", "car", "line"]
    return ["car", "line"]
