"""Conversion of records for other programs: data frames, HTML, GeoJSON geometries in pixels of the image."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape
from typing import TYPE_CHECKING, Any

from vehanchor.errors import MissingExtraError, PromptError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pydantic import BaseModel

_SHOWN_FLOAT_DIGITS = 4
_FRAME_TYPES = {float: "float64", int: "Int64", bool: "boolean", str: "string"}  # types with a missing value


def as_box(box: Any) -> Any:
    """Take the box of a shapely or supervision object, without importing either; return other values unchanged.

    Args:
        box: a geometry of shapely (its ``bounds``), or supervision's ``Detections`` of one object.

    Raises:
        PromptError: the detections are not of exactly one object.
    """
    found = getattr(box, "xyxy", None)
    if found is not None:
        if len(found) != 1:
            raise PromptError(f"the detections are of {len(found)} objects: give one, as detections[i : i + 1]")
        return tuple(float(value) for value in found[0])
    return getattr(box, "bounds", box)


def places_of(path: Any) -> Any:
    """Take the points of a shapely line; return other values unchanged.

    Raises:
        PromptError: the geometry is not a line.
    """
    try:
        places = getattr(path, "coords", path)
    except NotImplementedError:  # of shapely's polygons and collections
        raise PromptError(f"the path is a {type(path).__name__}: give a line, or points") from None
    if isinstance(places, str) or not isinstance(places, Iterable):
        raise PromptError(f"the path is {path!r}: give a line, or points as x, y")
    return places


def as_frame(records: Sequence[BaseModel]) -> Any:
    """Make a pandas table of records of one type, one row per record.

    Raises:
        MissingExtraError: pandas is not installed.
    """
    try:
        import pandas as pd
    except ImportError:
        raise MissingExtraError("to_frame needs pandas: pip install pandas") from None
    from vehanchor.records.flat import flat_columns, flat_row

    rows = [flat_row(record) for record in records]
    return pd.DataFrame(
        {
            name: pd.array([row[name] for row in rows], dtype=_FRAME_TYPES[kind])
            for name, kind in flat_columns(type(records[0])).items()
        }
    )


def as_html(values: Mapping[str, Any]) -> str:
    """Make an HTML table for notebooks: single values only, without nulls."""
    rows = []
    for name, value in values.items():
        if value is None or isinstance(value, dict | list | tuple):
            continue
        shown = f"{value:.{_SHOWN_FLOAT_DIGITS}g}" if isinstance(value, float) else str(value)
        rows.append(f"<tr><th style='text-align:left'>{escape(name)}</th><td>{escape(shown)}</td></tr>")
    notices = "".join(
        f"<tr><th style='text-align:left'>{escape(note['code'])}</th><td>{escape(note['message'])}</td></tr>"
        for note in values.get("warnings") or ()
    )
    return f"<table>{''.join(rows)}{notices}</table>"


def outline_geometry(outline: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Make a GeoJSON MultiPolygon of an outline; x to the right and y down, pixels of the full image."""
    return {
        "type": "MultiPolygon",
        "coordinates": [
            [_ring(piece["exterior"]["points"]), *(_ring(hole["points"]) for hole in piece["holes"])]
            for piece in outline
        ],
    }


def line_geometry(path: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """Make a GeoJSON LineString of a path; x to the right and y down, pixels of the full image."""
    return {"type": "LineString", "coordinates": [[point["x_px"], point["y_px"]] for point in path]}


def _ring(points: Sequence[Mapping[str, float]]) -> list[list[float]]:
    corners = [[point["x_px"], point["y_px"]] for point in points]
    return [*corners, corners[0]]
