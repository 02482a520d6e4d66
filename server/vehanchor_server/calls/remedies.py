"""Remedies for models: at most two, by arguments of every measuring tool, the one that helps most first."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.records import AreaMeasurement, GsdEstimate
from vehanchor.scale.defaults import USABLE_CHANCE

if TYPE_CHECKING:
    from pydantic import BaseModel

_MOST = 2
_REMEDIES = {
    "image": "send the original image",
    "drop": "drop boxes that are no cars, see view_image (drop)",
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
    """Say what would make a record usable; empty for a usable one."""
    if getattr(record, "status", "ok") == "ok":
        return ""
    estimate = record if isinstance(record, GsdEstimate) else getattr(record, "estimate", None)
    if estimate is not None and estimate.status != "ok":
        line = _BESIDE_CARS if estimate.n_vehicles else _WITHOUT_CARS
        return ", or ".join(_REMEDIES[name].format(line) for name in _remedies(estimate)[:_MOST])
    if isinstance(record, AreaMeasurement) and (
        record.scale_confidence is None or record.scale_confidence >= USABLE_CHANCE
    ):
        return _ON_CHOICES if record.alternatives else _ON_MASK
    return _ON_STATED


def _remedies(estimate: GsdEstimate) -> list[str]:
    codes = {notice.code for notice in estimate.warnings}
    n = estimate.n_vehicles or 0
    if estimate.reason == "too_coarse" or ("stretched" in codes and estimate.reason == "disagree"):
        return ["image", "line"]
    if estimate.reason in ("not_cars", "disagree"):
        return ["drop", "line"] if n else ["line"]
    is_fleet_open = bool(n) and estimate.details.reference_source in ("model", "appearance")
    return ["region", "car", "line"] if is_fleet_open else ["car", "line"]
