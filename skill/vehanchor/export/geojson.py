"""GeoJSON files: degrees of WGS 84, as the format requires, or pixels without a georeference.

RFC 7946 knows degrees only. Files in pixels have the member ``crs`` of the earlier standard, which GDAL and geopandas
read: without it they would take the pixels for degrees.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.export.layer import PIXELS_WKT, moved, on_ground

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from vehanchor.export.layer import Layer


def write_geojson(path: Path, layers: Sequence[Layer]) -> None:
    """Write layers as one collection of features."""
    features = [feature for layer in layers for feature in _placed(layer)]
    in_pixels = all(layer.ground is None for layer in layers)
    system = {"crs": {"type": "name", "properties": {"name": PIXELS_WKT}}} if in_pixels else {}
    path.write_text(json.dumps({"type": "FeatureCollection", **system, "features": features}), encoding="utf-8")


def _placed(layer: Layer) -> list[dict[str, Any]]:
    """Convert the features of a georeferenced image to degrees."""
    ground = layer.ground
    if ground is None:
        return layer.features
    from rasterio.warp import transform

    def degrees(points: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.column_stack(transform(ground.crs, "EPSG:4326", *on_ground(points, ground).T.tolist()))

    return [{**feature, "geometry": moved(feature["geometry"], degrees)} for feature in layer.features]
