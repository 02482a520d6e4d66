"""Compact answers for models: the deciding fields, with three digits."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

from vehanchor.records import AreaMeasurement, DistanceMeasurement, GsdEstimate, KnownScale
from vehanchor.records.advice import advice_for
from vehanchor.records.known_scale import KnownPlane
from vehanchor.scale.thresholds import FALLBACK_CONFIDENCE

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pydantic import BaseModel

REUSE_SCALE = "To measure more in this image, pass scale "
"""Text before a scale in words."""

ADVICE_ON_MASK = "give a tight box around the object"
ADVICE_ON_REUSE = "measure again without scale, with a known length or height"
"""Advice for a scale of an earlier answer that is not usable."""

_DIGITS = 3
_SCALE_DIGITS = 5  # of a reused scale, so that products keep three digits

ANSWERED: Mapping[type[BaseModel], tuple[str, ...]] = {
    GsdEstimate: (
        "status",
        "gsd_m_per_px",
        "confidence",
        "n_vehicles",
        "by_hand",
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
        "confidence",
        "gsd_m_per_px",
        "scale_source",
    ),
}
"""The fields of each record in a short answer, unless null."""

_SCALE_FIELDS = tuple(name for name in KnownScale.model_fields if name != "plane")
_PLANE_FIELDS = tuple(KnownPlane.model_fields)
_ID_FIELDS = ("image_id", "model_id")
_KEPT_WHEN_NULL = ("gsd_m_per_px", "area_m2", "distance_m")  # null means "no scale"
_OMITTED_IN_FRAME = ("width_px", "height_px", "gsd_ci95_low_m_per_px", "gsd_ci95_high_m_per_px")


def short_answer(records: Sequence[BaseModel]) -> dict[str, Any]:
    """Return one record, or several below ``measurements``, with their common advice, warnings and scale for reuse.

    Advice and codes of warnings are for hosts that show models the structured content alone.

    Args:
        records: records of one image.
    """
    parts = [_short(record) for record in records]
    whole: dict[str, Any] = parts[0] if len(parts) == 1 else {"measurements": parts}
    advice = [each for each in map(_advice, records) if each]
    codes = [notice.code for record in records for notice in getattr(record, "warnings", ())]
    for name, found in (("advice", "; ".join(dict.fromkeys(advice))), ("warnings", list(dict.fromkeys(codes)))):
        if found:
            whole[name] = found
    scale = _known_scale(records[0])
    return whole if scale is None else {**whole, "scale": scale}


def _advice(record: BaseModel) -> str:
    """Say what would make a record usable; empty for a usable one."""
    if getattr(record, "status", "ok") == "ok":
        return ""
    advice = advice_for(_estimate(record))
    if advice is not None:
        return advice.helps
    if isinstance(record, AreaMeasurement) and (record.confidence is None or record.confidence >= FALLBACK_CONFIDENCE):
        return ADVICE_ON_MASK
    return ADVICE_ON_REUSE


def scale_as_text(scale: Mapping[str, Any]) -> str:
    """Write a scale as one text, which models and hosts give back unchanged; nested fields can get lost.

    Args:
        scale: ``KnownScale`` as JSON.
    """
    plane = scale.get("plane") or {}
    return " ".join(str(value) for value in (*(scale[name] for name in _SCALE_FIELDS), *plane.values()))


def scale_from_text(value: Any) -> Any:
    """Read ``scale_as_text`` into the fields of a ``KnownScale``; return other values unchanged.

    Raises:
        ValueError: the text is not a scale.
    """
    if not isinstance(value, str):
        return value
    parts = value.split()
    n_fields = len(_SCALE_FIELDS)
    if len(parts) not in (n_fields, n_fields + len(_PLANE_FIELDS)):
        raise ValueError("it is not the scale of an earlier answer. Give that text back unchanged, or leave scale out")
    numbers = [part if name in _ID_FIELDS else _number(part) for name, part in zip(_SCALE_FIELDS, parts, strict=False)]
    plane = dict(zip(_PLANE_FIELDS, map(_number, parts[n_fields:]), strict=False))
    return {**dict(zip(_SCALE_FIELDS, numbers, strict=True)), "plane": plane or None}


def _number(part: str) -> float:
    try:
        return float(part)
    except ValueError:
        raise ValueError(f"{part[:20]!r} is not a number. Give back the scale of an earlier answer unchanged") from None


def scale_in_words(records: Sequence[BaseModel], short: Mapping[str, Any]) -> str:
    """Return the scale as text, for hosts that show models only text; empty without one.

    Args:
        records: records of one image.
        short: their ``short_answer``.
    """
    estimate = _estimate(records[0])
    if "scale" not in short or estimate is None:
        return ""
    return f'{REUSE_SCALE}"{short["scale"]}"'


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
    reason = getattr(getattr(record, "estimate", None), "reason", None)
    if reason is not None:
        short["reason"] = reason
    if (short.get("frame") or {}).get("bounding_box"):
        short.pop("bounding_box", None)  # the frame already has it in the caller's pixels
    return short


def _estimate(record: BaseModel) -> GsdEstimate | None:
    """Return the estimate behind a record, if any."""
    return record if isinstance(record, GsdEstimate) else getattr(record, "estimate", None)


def _known_scale(record: BaseModel) -> dict[str, Any] | None:
    known = getattr(_estimate(record), "scale", None)
    if known is None:
        return None
    return {name: _rounded(name, value, _SCALE_DIGITS) for name, value in known.model_dump(mode="json").items()}


def _rounded(name: str, value: Any, digits: int = _DIGITS) -> Any:
    if isinstance(value, dict):
        return {key: each if each is None else _rounded(key, each, digits) for key, each in value.items()}
    if not isinstance(value, float):
        return value
    if name in ("confidence", "p_within_20", "mask_score"):
        return math.floor(value * 10**digits) / 10**digits  # round down, never above a limit
    if name.endswith("_px") and not name.endswith("_per_px"):
        return round(value, 1)
    return float(f"{value:.{digits}g}")
