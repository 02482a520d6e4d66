"""GeoJSON files of boxes, outlines and lines.

Coordinates are degrees of WGS 84 for a georeferenced image, as the format requires, else pixels of
the image, y down. RFC 7946 knows degrees only. Files in pixels have the member ``crs`` of the
earlier standard, which GDAL and geopandas read: without it they would take the pixels for degrees.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

from vehanchor.errors import OutputError
from vehanchor.storage.atomic import check_output_path, whole_file

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from vehanchor.analysis.measurement_analysis import AreaAnalysis, DistanceAnalysis
    from vehanchor.analysis.scale_analysis import ScaleAnalysis
    from vehanchor.imagery.metadata.georeference import Ground

SUFFIX = ".geojson"
PIXELS_WKT = (
    'LOCAL_CS["Pixels of the image, y '
    'down",LOCAL_DATUM["Image",0],UNIT["pixel",1],AXIS["x",EAST],AXIS["y",SOUTH]]'
)
"""Reference system of an image without coordinates: GDAL and geopandas read the unit as pixels, not metres."""


def check_geojson_path(path: Path) -> None:
    """Check, before the work, that a file can be written to a path.

    Raises:
        OutputError: the suffix is another one, or the folder does not exist.
    """
    check_output_path(
        path, (SUFFIX,), kind="GeoJSON", also="ogr2ogr and geopandas convert it to other formats"
    )


def write_shapes(path: Path, analysis: ScaleAnalysis | AreaAnalysis | DistanceAnalysis) -> None:
    """Write the vehicles of a scale, or the measured outline or line with its size.

    Raises:
        OutputError: the file cannot be written.
    """
    found = analysis.__geo_interface__
    features = [each for each in found.get("features", [found]) if each["geometry"]["coordinates"]]
    write_features(path, [(each, analysis.ground) for each in features])


def write_features(path: Path, placed: Sequence[tuple[dict[str, Any], Ground | None]]) -> None:
    """Write features of one or many images.

    Args:
        path: path of the file, checked by ``check_geojson_path``.
        placed: features in pixels, each with the position of its image on the ground; None without
            a georeference.

    Raises:
        OutputError: the file cannot be written, or only some images are georeferenced.
    """
    if len({ground is None for _, ground in placed}) > 1:
        raise OutputError(
            "some images are georeferenced and others are not: write one file for each kind"
        )
    collection: dict[str, Any] = {"type": "FeatureCollection"}
    if all(ground is None for _, ground in placed):
        collection["crs"] = {"type": "name", "properties": {"name": PIXELS_WKT}}
    collection["features"] = [
        feature if ground is None else _in_degrees(feature, ground) for feature, ground in placed
    ]
    with whole_file(path) as partial:
        partial.write_text(json.dumps(collection), encoding="utf-8")


def _in_degrees(feature: dict[str, Any], ground: Ground) -> dict[str, Any]:
    """Convert a feature of a georeferenced image to degrees."""
    from rasterio.warp import transform

    a, b, c, d, e, f = ground.transform[:6]

    def moved(part: Any) -> list[Any]:
        if not isinstance(part[0][0], int | float):
            return [moved(each) for each in part]
        eastings = [a * x + b * y + c for x, y in part]
        northings = [d * x + e * y + f for x, y in part]
        longitudes, latitudes = transform(ground.crs, "EPSG:4326", eastings, northings)
        return list(map(list, zip(longitudes, latitudes, strict=True)))

    geometry = feature["geometry"]
    return {**feature, "geometry": {**geometry, "coordinates": moved(geometry["coordinates"])}}
