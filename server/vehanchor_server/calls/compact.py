"""Compact answers for models: the deciding fields, with three digits."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from vehanchor.records import AreaMeasurement, DistanceMeasurement, GsdEstimate, OtherObject
from vehanchor.records.text import advice_for
from vehanchor.scale.defaults import USABLE_CHANCE

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pydantic import BaseModel

ADVICE_ON_MASK = "give a tight box around the object"
ADVICE_ON_STATED = "leave out gsd_m_per_px, or draw a line over something of known size (known_lengths)"
"""Advice for a stated scale that is not usable."""

_DIGITS = 3

ANSWERED: Mapping[type[BaseModel], tuple[str, ...]] = {
    GsdEstimate: (
        "status",
        "gsd_m_per_px",
        "gsd_ci95_low_m_per_px",
        "gsd_ci95_high_m_per_px",
        "confidence",
        "n_vehicles",
        "mode_length_px",
        "reason",
        "leading_ruler",
        "image_width_px",
        "image_height_px",
        "frame",
    ),
    AreaMeasurement: (
        "status",
        "area_m2",
        "area_ci95_low_m2",
        "area_ci95_high_m2",
        "confidence",
        "gsd_m_per_px",
        "scale_source",
        "length_m",
        "width_m",
        "perimeter_m",
        "inscribed_diameter_m",
        "inscribed_diameter_ci95_low_m",
        "inscribed_center",
        "bounding_box",
        "frame",
        "mask_score",
    ),
    DistanceMeasurement: (
        "status",
        "distance_m",
        "distance_ci95_low_m",
        "distance_ci95_high_m",
        "distance_ci95_high_m",
        "confidence",
        "gsd_m_per_px",
        "scale_source",
    ),
}
"""The fields of each record in a short record, unless null."""

_KEPT_WHEN_NULL = ("gsd_m_per_px", "area_m2", "distance_m")  # null means "no scale"
_OMITTED_IN_FRAME = ("width_px", "height_px", "gsd_ci95_low_m_per_px", "gsd_ci95_high_m_per_px")


def short_record(records: Sequence[BaseModel]) -> dict[str, Any]:
    """Return one record, or several below ``measurements``, with their common advice and warnings.

    Advice and the first sentences of warnings are for hosts that show models the structured content alone.

    Args:
        records: records of one image.
    """
    parts = [_short(record) for record in records]
    whole: dict[str, Any] = parts[0] if len(parts) == 1 else {"measurements": parts}
    advice = [each for each in map(_advice, records) if each]
    notices = [notice for record in records for notice in getattr(record, "warnings", ())]
    words = [f"{notice.code}: {notice.message.partition('. ')[0].rstrip('.')}" for notice in notices]
    for name, found in (("advice", "; ".join(dict.fromkeys(advice))), ("warnings", list(dict.fromkeys(words)))):
        if found:
            whole[name] = found
    return whole


def _advice(record: BaseModel) -> str:
    """Say what would make a record usable; empty for a usable one."""
    if getattr(record, "status", "ok") == "ok":
        return ""
    advice = advice_for(_estimate(record))
    if advice is not None:
        return advice.helps
    if isinstance(record, AreaMeasurement) and (record.confidence is None or record.confidence >= USABLE_CHANCE):
        return ADVICE_ON_MASK
    return ADVICE_ON_STATED


def _short(record: BaseModel) -> dict[str, Any]:
    values = record.model_dump(mode="json")
    if type(record) not in ANSWERED:
        return values
    short: dict[str, Any] = {}
    for name in ANSWERED[type(record)]:
        value = values[name]
        if isinstance(value, dict) and name == "frame":
            value = {key: each for key, each in value.items() if key not in _OMITTED_IN_FRAME}
        if value is not None or name in _KEPT_WHEN_NULL:
            short[name] = _rounded(name, value)
    if isinstance(record, GsdEstimate) and record.details.by_hand is not None:
        short["by_hand"] = values["details"]["by_hand"]
    reason = getattr(getattr(record, "estimate", None), "reason", None)
    if reason is not None:
        short["reason"] = reason
    if isinstance(record, AreaMeasurement) and record.alternatives:
        short["alternatives"] = [_choice(record, other) for other in record.alternatives]
    if (short.get("frame") or {}).get("bounding_box"):
        short.pop("bounding_box", None)  # the frame already has it in the caller's pixels
    return short


def _choice(area: AreaMeasurement, other: OtherObject) -> dict[str, Any]:
    """Return the size of another object that a point may mean, and its box in the caller's pixels."""
    box, frame = other.bounding_box, area.frame
    if frame is not None:
        box = box.scaled(frame.width_px / area.image_width_px, frame.height_px / area.image_height_px)
    corners = [round(side) for side in (box.x1_px, box.y1_px, box.x2_px, box.y2_px)]
    return {"area_m2": _rounded("area_m2", other.area_m2), "box": corners}


def _estimate(record: BaseModel) -> GsdEstimate | None:
    """Return the estimate behind a record, if any."""
    return record if isinstance(record, GsdEstimate) else getattr(record, "estimate", None)


def _rounded(name: str, value: Any) -> Any:
    if isinstance(value, dict):
        return {key: each if each is None else _rounded(key, each) for key, each in value.items()}
    if not isinstance(value, float):
        return value
    if name in ("confidence", "mask_score"):
        return math.floor(value * 10**_DIGITS) / 10**_DIGITS  # round down, never above a limit
    if name.endswith("_px") and not name.endswith("_per_px"):
        return round(value, 1)
    return float(f"{value:.{_DIGITS}g}")
