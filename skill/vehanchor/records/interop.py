"""Boxes and lines of other programs as inputs."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from vehanchor.errors import PromptError


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
