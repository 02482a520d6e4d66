"""Compact answers for models: the deciding fields, with three digits."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from vehanchor.records import AreaMeasurement, DistanceMeasurement, GsdEstimate, OtherObject
from vehanchor.records.notices import NoticeCode
from vehanchor_server.calls.remedies import advice_on

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pydantic import BaseModel

_DIGITS = 3
_LONG_CHARS = 100  # of a sentence; a choice

ANSWERED: Mapping[type[BaseModel], tuple[str, ...]] = {
    GsdEstimate: (
        "status",
        "gsd_m_per_px",
        "gsd_ci95_low_m_per_px",
        "gsd_ci95_high_m_per_px",
        "confidence",
        "n_vehicles",
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
        "scale_confidence",
        "gsd_m_per_px",
        "length_m",
        "width_m",
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
        "scale_confidence",
        "gsd_m_per_px",
    ),
}
"""The fields of each record in a short record, unless null."""

_ONLY_IF_OK = (
    "length_m",
    "width_m",
    "inscribed_diameter_m",
    "inscribed_diameter_ci95_low_m",
    "inscribed_center",
)
# null means "no scale"
_KEPT_WHEN_NULL = ("gsd_m_per_px", "area_m2", "distance_m", "scale_confidence")
_OMITTED_IN_FRAME = ("width_px", "height_px", "gsd_ci95_low_m_per_px", "gsd_ci95_high_m_per_px")


def short_record(records: Sequence[BaseModel], warnings: Sequence[str] = ()) -> dict[str, Any]:
    """Return one record, or several below ``measurements``, with their common advice, and the warnings in words.

    Args:
        records: records of one image.
        warnings: theirs and those about the call.
    """
    parts = [_short(record) for record in records]
    whole: dict[str, Any] = parts[0] if len(parts) == 1 else {"measurements": parts}
    advice = "; ".join(dict.fromkeys(filter(None, map(advice_on, records))))
    return (
        whole
        | ({"advice": advice} if advice else {})
        | ({"warnings": list(warnings)} if warnings else {})
    )


def brief(message: str) -> str:
    """Return the first sentence of a message; of a long one, the clause that states the fact."""
    sentence = message.partition(". ")[0].rstrip(".")
    return (sentence if len(sentence) <= _LONG_CHARS else sentence.partition(": ")[0]) + "."


def _short(record: BaseModel) -> dict[str, Any]:
    values = record.model_dump(mode="json")
    if type(record) not in ANSWERED:
        return values
    short: dict[str, Any] = {}
    for name in ANSWERED[type(record)]:
        if name in _ONLY_IF_OK and values["status"] != "ok":
            continue
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
        short["alternatives"] = [_size(other) for other in record.alternatives]
    frame = short.get("frame") or {}
    if has_unknown_extent(record):
        frame.pop("bounding_box", None)
        short.pop("bounding_box", None)
    elif frame.get("bounding_box"):
        short.pop("bounding_box", None)  # the frame already has it in the caller's pixels
    return short


def has_unknown_extent(record: BaseModel) -> bool:
    """Tell whether the mask may be a part of the object, or more.

    Its box is not told: given back, it would pass for one that somebody drew
    (``research/results/notes.md``).
    """
    notices = record.warnings if isinstance(record, AreaMeasurement) else ()
    return any(notice.code == NoticeCode.EXTENT_UNKNOWN for notice in notices)


def _size(other: OtherObject) -> dict[str, Any]:
    """Return the size of another object that a point may mean."""
    name = "mask_area_px" if other.area_m2 is None else "area_m2"
    return {name: _rounded(name, getattr(other, name))}


def _rounded(name: str, value: Any) -> Any:
    if isinstance(value, dict):
        return {key: each if each is None else _rounded(key, each) for key, each in value.items()}
    if not isinstance(value, float):
        return value
    if name in ("confidence", "scale_confidence", "mask_score"):
        return math.floor(value * 10**_DIGITS) / 10**_DIGITS  # round down, never above a limit
    if name.endswith("_px") and not name.endswith("_per_px"):
        return round(value, 1)
    return float(f"{value:.{_DIGITS}g}")
