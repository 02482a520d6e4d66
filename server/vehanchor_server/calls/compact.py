"""Compact answers for models: the fields that records mark as ``Short``, with three digits."""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from vehanchor.records import AreaMeasurement, GsdEstimate, OtherObject
from vehanchor.records.notices import NoticeCode
from vehanchor.records.record import Short
from vehanchor_server.calls.remedies import advice_on

if TYPE_CHECKING:
    from collections.abc import Sequence

_DIGITS = 3
_LONG_CHARS = 100  # a longer sentence loses its last clauses


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
    """Return the first sentence of a message; of a long one, as many clauses as are short."""
    sentence = message.partition(". ")[0].rstrip(".")
    while len(sentence) > _LONG_CHARS and ": " in sentence:
        sentence, _, _ = sentence.rpartition(": ")
    return f"{sentence}."


def _short(record: BaseModel) -> dict[str, Any]:
    """Return the deciding fields of a record; a record of another type stays whole."""
    short = _marked(record)
    if isinstance(record, GsdEstimate):
        short |= _marked(record.details)
    reason = getattr(getattr(record, "estimate", None), "reason", None)
    if reason is not None:
        short["reason"] = reason
    if isinstance(record, AreaMeasurement):
        if record.alternatives:
            short["alternatives"] = [_size(other) for other in record.alternatives]
        _drop_superfluous_box(short, record)
        if record.fit is not None:
            _drop_sizes(short)
    return short


def _marked(record: BaseModel) -> dict[str, Any]:
    """Return the fields of a record that are marked as ``Short``; all if none is marked."""
    marks = short_fields(type(record))
    if not marks:
        return record.model_dump(mode="json")
    is_ok = getattr(record, "status", "ok") == "ok"
    values: dict[str, Any] = {}
    for name, mark in marks.items():
        value = getattr(record, name)
        if mark.only_if_ok and not is_ok:
            continue
        is_empty = value is None or value == ()
        if not is_empty or mark.when_null:
            values[name] = _shortened(name, value, mark)
    return values


@cache
def short_fields(kind: type[BaseModel]) -> dict[str, Short]:
    """List the fields of a type of record that are marked as ``Short``, with their marks."""
    return {
        name: mark
        for name, field in kind.model_fields.items()
        for mark in field.metadata
        if isinstance(mark, Short)
    }


def _shortened(name: str, value: Any, mark: Short) -> Any:
    """Shorten the record in a field, or round the number in it."""
    if isinstance(value, BaseModel):
        return _rounded(name, _marked(value))
    if isinstance(value, tuple):
        return [_shortened(name, item, mark) for item in value]
    if mark.round_down and value is not None:
        return math.floor(value * 10**_DIGITS) / 10**_DIGITS
    return _rounded(name, value)


def _drop_superfluous_box(short: dict[str, Any], area: AreaMeasurement) -> None:
    """Keep one box of the mask: the one in the caller's pixels; none if the extent is unknown."""
    frame = short.get("frame", {})
    if has_unknown_extent(area):
        frame.pop("bounding_box", None)
        short.pop("bounding_box", None)
    elif frame.get("bounding_box"):
        short.pop("bounding_box", None)


def _drop_sizes(short: dict[str, Any]) -> None:
    """Drop what a caller who asks whether a shape fits does not need: other sizes and boxes.

    The largest circle stays: it is what may be asked next. Places are given once: in the caller's
    pixels.
    """
    superfluous = ("inscribed_center", "inscribed_diameter_ci95", "length_", "width_", "bounding_")
    for name in list(short):
        if name.startswith(superfluous):
            del short[name]
    frame = short.get("frame", {})
    frame.pop("bounding_box", None)
    if "fit_center" in frame:
        short["fit"].pop("center", None)
        short["fit"].pop("corners", None)


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
    """Round the numbers of a field to the precision of its unit."""
    if isinstance(value, dict):
        return {key: _rounded(key, item) for key, item in value.items()}
    if not isinstance(value, float):
        return value
    if name.endswith("_px") and not name.endswith("_per_px"):
        return round(value, 1)
    return float(f"{value:.{_DIGITS}g}")
