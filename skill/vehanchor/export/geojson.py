"""GeoJSON files of boxes, outlines and lines.

Coordinates are degrees of WGS 84 for a georeferenced image, as RFC 7946 requires. For other images
they are pixels of the image, y down. These files have the member ``crs`` of the standard before
RFC 7946, which GDAL and geopandas read. Without it they would take the pixels for degrees.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any, TypeAlias

from vehanchor.errors import OutputError
from vehanchor.imagery.metadata.georeference import PIXELS_WKT
from vehanchor.storage.atomic import check_output_path, whole_file

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from vehanchor.analysis.measurement_analysis import AreaAnalysis, DistanceAnalysis
    from vehanchor.analysis.scale_analysis import ScaleAnalysis
    from vehanchor.imagery.metadata.georeference import Ground

    Feature: TypeAlias = dict[str, Any]

    PlacedFeature: TypeAlias = tuple[Feature, Ground | None]
    """Feature in pixels, and the position of its image on the ground."""

SUFFIXES = (".geojson",)


def check_geojson_path(path: Path) -> None:
    """Check, before the work, that a file can be written to a path.

    Raises:
        OutputError: the suffix is another one, or the folder does not exist.
    """
    check_output_path(
        path, SUFFIXES, kind="GeoJSON", also="ogr2ogr and geopandas convert it to other formats"
    )


def write_shapes(path: Path, analysis: ScaleAnalysis | AreaAnalysis | DistanceAnalysis) -> None:
    """Write the vehicles of a scale, or the measured outline or line with its size.

    Raises:
        OutputError: the file cannot be written.
    """
    shapes = analysis.__geo_interface__
    # A measurement is one feature, a scale a collection of them.
    features = shapes.get("features", [shapes])
    drawn = [feature for feature in features if feature["geometry"]["coordinates"]]
    write_features(path, [(feature, analysis.ground) for feature in drawn])


def write_features(path: Path, placed: Sequence[PlacedFeature]) -> None:
    """Write features of one or many images.

    Args:
        path: path of the file, checked by ``check_geojson_path``.
        placed: features in pixels, each with the position of its image on the ground; None without
            a georeference.

    Raises:
        OutputError: the file cannot be written, or only some images are georeferenced.
    """
    in_pixels = [ground is None for _, ground in placed]
    if any(in_pixels) and not all(in_pixels):
        raise OutputError(
            "some images are georeferenced and others are not: write one file for each kind"
        )
    collection: dict[str, Any] = {"type": "FeatureCollection"}
    if all(in_pixels):
        collection["crs"] = {"type": "name", "properties": {"name": PIXELS_WKT}}
    features = []
    for feature, ground in placed:
        if ground is not None:
            feature = _in_degrees(feature, ground)
        features.append(feature)
    collection["features"] = features
    with whole_file(path) as partial:
        partial.write_text(json.dumps(collection), encoding="utf-8")


def _in_degrees(feature: Feature, ground: Ground) -> Feature:
    """Convert a feature of a georeferenced image to degrees."""
    geometry = feature["geometry"]
    coordinates = _coordinates_in_degrees(geometry["coordinates"], ground)
    return {**feature, "geometry": {**geometry, "coordinates": coordinates}}


def _coordinates_in_degrees(coordinates: Any, ground: Ground) -> list[Any]:
    """Convert a line of x, y, or nested lists of lines such as those of a polygon."""
    from rasterio.warp import transform

    is_line = isinstance(coordinates[0][0], int | float)
    if not is_line:
        return [_coordinates_in_degrees(part, ground) for part in coordinates]
    # The affine transform of the file, from pixels to its reference system.
    a, b, c, d, e, f = ground.transform[:6]
    eastings = [a * x + b * y + c for x, y in coordinates]
    northings = [d * x + e * y + f for x, y in coordinates]
    longitudes, latitudes = transform(ground.crs, "EPSG:4326", eastings, northings)
    return [[x, y] for x, y in zip(longitudes, latitudes, strict=True)]
