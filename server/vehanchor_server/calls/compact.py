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
_LONG_CHARS = 100  # a longer sentence is cut to its first clause

SHORT_FIELDS: Mapping[type[BaseModel], tuple[str, ...]] = {
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
# Null states that there is no scale.
_KEPT_WHEN_NULL = ("gsd_m_per_px", "area_m2", "distance_m", "scale_confidence")
_OMITTED_IN_FRAME = ("width_px", "height_px", "gsd_ci95_low_m_per_px", "gsd_ci95_high_m_per_px")


def short_record(records: Sequence[BaseModel], warnings: Sequence[str] = ()) -> dict[str, Any]:
    """Return one record, or several below ``measurements``, with advice and warnings.

    Args:
        records: records of one image.
        warnings: those of the records and those about the call, in words.
    """
    parts = [_short(record) for record in records]
    short: dict[str, Any] = {"measurements": parts}
    if len(parts) == 1:
        short = parts[0]
    advice = [advice_on(record) for record in records]
    advice = [text for text in dict.fromkeys(advice) if text]
    if advice:
        short["advice"] = "; ".join(advice)
    if warnings:
        short["warnings"] = list(warnings)
    return short


def brief(message: str) -> str:
    """Return the first sentence of a message; of a long one, the clause that states the fact."""
    sentence = message.partition(". ")[0].rstrip(".")
    if len(sentence) > _LONG_CHARS:
        sentence = sentence.partition(": ")[0]
    return f"{sentence}."


def _short(record: BaseModel) -> dict[str, Any]:
    """Return the deciding fields of a record; a record of another type stays whole."""
    values = record.model_dump(mode="json")
    if type(record) not in SHORT_FIELDS:
        return values
    short: dict[str, Any] = {}
    for name in SHORT_FIELDS[type(record)]:
        if name in _ONLY_IF_OK and values["status"] != "ok":
            continue
        value = values[name]
        if name == "frame" and value is not None:
            value = {key: item for key, item in value.items() if key not in _OMITTED_IN_FRAME}
        if value is not None or name in _KEPT_WHEN_NULL:
            short[name] = _rounded(name, value)
    if isinstance(record, GsdEstimate) and record.details.by_hand is not None:
        short["by_hand"] = values["details"]["by_hand"]
    reason = getattr(getattr(record, "estimate", None), "reason", None)
    if reason is not None:
        short["reason"] = reason
    if isinstance(record, AreaMeasurement):
        if record.alternatives:
            short["alternatives"] = [_size(other) for other in record.alternatives]
        _drop_superfluous_box(short, record)
    return short


def _drop_superfluous_box(short: dict[str, Any], area: AreaMeasurement) -> None:
    """Keep one box of the mask: the one in the caller's pixels; none if the extent is unknown."""
    frame = short.get("frame", {})
    if has_unknown_extent(area):
        frame.pop("bounding_box", None)
        short.pop("bounding_box", None)
    elif frame.get("bounding_box"):
        short.pop("bounding_box", None)


def has_unknown_extent(area: AreaMeasurement) -> bool:
    """Return whether the mask may be a part of the object, or more than the object.

    Answers omit the box of such a mask: given back, it would pass for one that somebody drew
    (``research/results/notes.md``).
    """
    return any(notice.code == NoticeCode.EXTENT_UNKNOWN for notice in area.warnings)


def _size(other: OtherObject) -> dict[str, Any]:
    """Return the size of another object that a point may mean."""
    name = "mask_area_px" if other.area_m2 is None else "area_m2"
    return {name: _rounded(name, getattr(other, name))}


def _rounded(name: str, value: Any) -> Any:
    """Round the numbers of a field: to the precision of its unit, and chances downward."""
    if isinstance(value, dict):
        return {key: _rounded(key, item) for key, item in value.items()}
    if not isinstance(value, float):
        return value
    if name in ("confidence", "scale_confidence", "mask_score"):
        # Downward, so that no rounded chance passes a limit that the chance itself misses.
        return math.floor(value * 10**_DIGITS) / 10**_DIGITS
    if name.endswith("_px") and not name.endswith("_per_px"):
        return round(value, 1)
    return float(f"{value:.{_DIGITS}g}")
