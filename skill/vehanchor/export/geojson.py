"""GeoJSON files: degrees of WGS 84, as the format requires, or pixels without a georeference.

RFC 7946 knows degrees only. Files in pixels have the member ``crs`` of the earlier standard, which GDAL and geopandas
read: without it they would take the pixels for degrees.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.export.layer import PIXELS_WKT, moved, on_ground

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from vehanchor.export.layer import Layer
    from vehanchor.imagery.metadata.georeference import Ground


def write_geojson(path: Path, layer: Layer, ground: Ground | None) -> None:
    """Write a layer as a collection of features."""
    features = layer.features
    system = {"crs": {"type": "name", "properties": {"name": PIXELS_WKT}}}
    if ground is not None:
        system = {}
        from rasterio.warp import transform

        def degrees(points: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.column_stack(transform(ground.crs, "EPSG:4326", *on_ground(points, ground).T.tolist()))

        features = [{**feature, "geometry": moved(feature["geometry"], degrees)} for feature in features]
    path.write_text(json.dumps({"type": "FeatureCollection", **system, "features": features}), encoding="utf-8")
