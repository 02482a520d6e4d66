"""Vector files of boxes, outlines and lines: GeoJSON and GeoPackage for maps, DOTA's text for training detectors.

Coordinates are on the ground for a georeferenced file, else in pixels of the image, y down.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.errors import OutputError
from vehanchor.export.geopackage import write_geopackage
from vehanchor.export.layer import Layer, moved, on_ground, rings
from vehanchor.storage.atomic import whole_file

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.analysis.measured import AreaAnalysis, DistanceAnalysis
    from vehanchor.analysis.scale import ScaleAnalysis
    from vehanchor.imagery.metadata.georeference import Ground

BOX_SUFFIXES = (".geojson", ".gpkg", ".txt")
LINE_SUFFIXES = (".geojson", ".gpkg")  # DOTA has boxes only


def check_boxes_path(path: str | Path, suffixes: tuple[str, ...] = BOX_SUFFIXES) -> Path:
    """Check, before the work, that a vector file can be written to a path.

    Raises:
        OutputError: the suffix is not one of ``suffixes``, or the folder does not exist.
    """
    target = Path(path)
    if target.suffix.lower() not in suffixes:
        what = "boxes" if suffixes == BOX_SUFFIXES else "lines"
        raise OutputError(f"cannot write {what} as {str(path)!r}: use one of the suffixes {', '.join(suffixes)}")
    if not target.parent.is_dir() or target.is_dir():
        raise OutputError(f"cannot write {str(path)!r}: name a file in a folder that exists")
    return target


def write_boxes(path: str | Path, analysis: ScaleAnalysis) -> Path:
    """Write the vehicles of an analysis; the suffix chooses the format.

    Args:
        path: ``.geojson`` (for a georeferenced file in degrees of WGS 84, as the format requires), ``.gpkg`` (in the
            file's own reference system), or ``.txt`` (DOTA's four corners, class and difficulty, always in pixels).
        analysis: the analysis of an image.

    Returns:
        The path.

    Raises:
        OutputError: as ``check_boxes_path``, or the file cannot be written.
    """
    columns = {"kept": bool, "score": float, "length_px": float}
    layer = Layer("vehicles", analysis.__geo_interface__["features"], columns, "Polygon", "vehicle")
    return _write(check_boxes_path(path), layer, analysis.ground)


def write_measured(path: str | Path, analysis: AreaAnalysis | DistanceAnalysis) -> Path:
    """Write the measured outline or line with its size; the suffix chooses the format.

    Args:
        path: as in ``write_boxes``; DOTA's text has the smallest rotated rectangle of an outline, and no lines.
        analysis: the analysis of a measurement.

    Returns:
        The path.

    Raises:
        OutputError: as ``check_boxes_path``, or the file cannot be written.
    """
    feature = analysis.__geo_interface__
    geometry = feature["geometry"]
    is_line = geometry["type"] == "LineString"
    columns = {name: str if name == "status" else float for name in feature["properties"]}
    features = [feature] if geometry["coordinates"] else []
    layer = Layer("lines" if is_line else "outlines", features, columns, geometry["type"], "object")
    return _write(check_boxes_path(path, LINE_SUFFIXES if is_line else BOX_SUFFIXES), layer, analysis.ground)


def _write(target: Path, layer: Layer, ground: Ground | None) -> Path:
    suffix = target.suffix.lower()
    with whole_file(target) as partial:
        if suffix == ".txt":
            partial.write_text(_dota(layer), encoding="utf-8")
        elif suffix == ".geojson":
            partial.write_text(json.dumps(_geojson(layer, ground)), encoding="utf-8")
        else:
            write_geopackage(partial, layer, ground)
    return target


def _dota(layer: Layer) -> str:
    import cv2

    lines = []
    for feature in layer.features:
        found = rings(feature["geometry"])
        corners = np.array(found[0][:4])
        if layer.kind != "Polygon":
            corners = cv2.boxPoints(cv2.minAreaRect(np.concatenate(found).astype(np.float32))).astype(float)
        lines.append(" ".join(f"{value:.1f}" for value in corners.ravel()) + f" {layer.category} 0\n")
    return "".join(lines)


def _geojson(layer: Layer, ground: Ground | None) -> dict[str, Any]:
    features = layer.features
    if ground is not None:
        from rasterio.warp import transform

        def degrees(points: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.column_stack(transform(ground.crs, "EPSG:4326", *on_ground(points, ground).T.tolist()))

        features = [{**feature, "geometry": moved(feature["geometry"], degrees)} for feature in features]
    return {"type": "FeatureCollection", "features": features}
