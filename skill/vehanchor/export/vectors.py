"""Boxes, outlines and lines for other programs: GeoJSON and GeoPackage for maps, DOTA's text for training detectors.

Those of a georeferenced file are where they are on the ground; of any other image they are in its pixels, y down.
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
    """Make sure that boxes, or what else these suffixes are for, can be written there, before the work of finding them.

    Raises:
        OutputError: the suffix is none of ``suffixes``, or the folder does not exist.
    """
    target = Path(path)
    if target.suffix.lower() not in suffixes:
        what = "boxes" if suffixes == BOX_SUFFIXES else "lines"
        raise OutputError(f"cannot write {what} as {str(path)!r}: use one of the suffixes {', '.join(suffixes)}")
    if not target.parent.is_dir() or target.is_dir():
        raise OutputError(f"cannot write {str(path)!r}: name a file in a folder that exists")
    return target


def write_boxes(path: str | Path, analysis: ScaleAnalysis) -> Path:
    """Write the vehicles of an analysis in the form that the suffix says.

    Args:
        path: ``.geojson`` (degrees of WGS 84, as the format wants, for a georeferenced file), ``.gpkg`` (the file's own
            coordinate system), or ``.txt``, DOTA's lines of four corners, class and difficulty, always in pixels.
        analysis: of an image.

    Returns:
        The path.

    Raises:
        OutputError: see ``check_boxes_path``; or the file system refuses.
    """
    columns = {"kept": bool, "score": float, "length_px": float}
    layer = Layer("vehicles", analysis.__geo_interface__["features"], columns, "Polygon", "vehicle")
    return _write(check_boxes_path(path), layer, analysis.ground)


def write_measured(path: str | Path, analysis: AreaAnalysis | DistanceAnalysis) -> Path:
    """Write the outline, or the line, that was measured, with its metres, in the form that the suffix says.

    Args:
        path: as in ``write_boxes``; DOTA's text has the smallest turned rectangle around an outline, and no lines.
        analysis: what was measured.

    Returns:
        The path.

    Raises:
        OutputError: see ``check_boxes_path``; or the file system refuses.
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
