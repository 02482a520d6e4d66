"""Layers: features of one kind, in pixels or on the ground."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from vehanchor.imagery.metadata.georeference import Ground


PIXELS_WKT = (
    'LOCAL_CS["Pixels of the image, y down",LOCAL_DATUM["Image",0],UNIT["pixel",1],AXIS["x",EAST],AXIS["y",SOUTH]]'
)
"""Reference system of an image without coordinates: GDAL and geopandas read the unit as pixels, not metres."""


class Layer(NamedTuple):
    """Features of one image.

    Attributes:
        name: name of the table.
        features: GeoJSON features in pixels of the image, all of one kind and with the same properties.
        columns: names and types of the properties.
        kind: kind of the geometries.
        category: DOTA's category of each.
        ground: position of the image on the ground; None for pixels.
    """

    name: str
    features: list[dict[str, Any]]
    columns: Mapping[str, type]
    kind: str
    category: str
    ground: Ground | None


def rings(geometry: dict[str, Any]) -> list[NDArray[np.float64]]:
    """List all rings or lines of a geometry, each ``[n, 2]``."""
    parts = geometry["coordinates"]
    if geometry["type"] == "LineString":
        parts = [parts]
    elif geometry["type"] == "MultiPolygon":
        parts = [ring for polygon in parts for ring in polygon]
    return [np.array(part, dtype=np.float64) for part in parts]


def moved(geometry: dict[str, Any], move: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> dict[str, Any]:
    """Convert a geometry to other coordinates."""

    def in_other(part: Any) -> Any:
        if isinstance(part[0][0], int | float):
            return move(np.array(part, dtype=np.float64)).tolist()
        return [in_other(each) for each in part]

    return {**geometry, "coordinates": in_other(geometry["coordinates"])}


def on_ground(points: NDArray[np.float64], ground: Ground) -> NDArray[np.float64]:
    """Convert points ``[n, 2]`` in pixels to the reference system of the image."""
    a, b, c, d, e, f = ground.transform[:6]
    x, y = points[:, 0], points[:, 1]
    return np.column_stack([a * x + b * y + c, d * x + e * y + f])
