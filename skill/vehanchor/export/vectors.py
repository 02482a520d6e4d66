"""Boxes, outlines and lines for other programs: GeoJSON and GeoPackage for maps, DOTA's text for training detectors.

Those of a georeferenced file are where they are on the ground; of any other image they are in its pixels, y down.
"""

from __future__ import annotations

import json
import sqlite3
import struct
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vehanchor.errors import OutputError
from vehanchor.storage.atomic import whole_file

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import NDArray

    from vehanchor.analysis.measured import AreaAnalysis, DistanceAnalysis
    from vehanchor.analysis.scale import ScaleAnalysis
    from vehanchor.imagery.metadata.georeference import Ground

BOX_SUFFIXES = (".geojson", ".gpkg", ".txt")
LINE_SUFFIXES = (".geojson", ".gpkg")  # DOTA has boxes only
_WKB_KINDS = {"LineString": 2, "Polygon": 3, "MultiPolygon": 6}
_COLUMN_TYPES = {bool: "BOOLEAN", str: "TEXT"}  # all others are DOUBLE

_GPKG_ID, _GPKG_VERSION = 0x47504B47, 10300  # "GPKG", version 1.3
_UNDEFINED_SRS = -1  # of the standard: Cartesian, of no known place
_WGS84 = (  # which every GeoPackage names
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.0174532925199433],AUTHORITY["EPSG","4326"]]'
)
_GPKG_TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY,
  organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
  description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER);
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL PRIMARY KEY, column_name TEXT NOT NULL,
  geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL);
"""


class _Layer(NamedTuple):
    """What one file holds.

    Attributes:
        name: of the table.
        features: as GeoJSON has them, in pixels of the image; all of one kind, with the same properties.
        columns: the properties' names and types.
        kind: of their geometries.
        category: DOTA's, of each.
    """

    name: str
    features: list[dict[str, Any]]
    columns: Mapping[str, type]
    kind: str
    category: str


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
    layer = _Layer("vehicles", analysis.__geo_interface__["features"], columns, "Polygon", "vehicle")
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
    layer = _Layer("lines" if is_line else "outlines", features, columns, geometry["type"], "object")
    return _write(check_boxes_path(path, LINE_SUFFIXES if is_line else BOX_SUFFIXES), layer, analysis.ground)


def _write(target: Path, layer: _Layer, ground: Ground | None) -> Path:
    suffix = target.suffix.lower()
    with whole_file(target) as partial:
        if suffix == ".txt":
            partial.write_text(_dota(layer), encoding="utf-8")
        elif suffix == ".geojson":
            partial.write_text(json.dumps(_geojson(layer, ground)), encoding="utf-8")
        else:
            _write_geopackage(partial, layer, ground)
    return target


def _dota(layer: _Layer) -> str:
    import cv2

    lines = []
    for feature in layer.features:
        rings = _rings(feature["geometry"])
        corners = np.array(rings[0][:4])
        if layer.kind != "Polygon":
            corners = cv2.boxPoints(cv2.minAreaRect(np.concatenate(rings).astype(np.float32))).astype(float)
        lines.append(" ".join(f"{value:.1f}" for value in corners.ravel()) + f" {layer.category} 0\n")
    return "".join(lines)


def _geojson(layer: _Layer, ground: Ground | None) -> dict[str, Any]:
    features = layer.features
    if ground is not None:
        from rasterio.warp import transform

        def degrees(points: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.column_stack(transform(ground.crs, "EPSG:4326", *_on_ground(points, ground).T.tolist()))

        features = [{**feature, "geometry": _moved(feature["geometry"], degrees)} for feature in features]
    return {"type": "FeatureCollection", "features": features}


def _write_geopackage(path: Path, layer: _Layer, ground: Ground | None) -> None:
    systems: list[tuple[str, int, str, int, str]] = [
        ("Undefined Cartesian", _UNDEFINED_SRS, "NONE", _UNDEFINED_SRS, "undefined"),
        ("Undefined geographic", 0, "NONE", 0, "undefined"),
        ("WGS 84", 4326, "EPSG", 4326, _WGS84),
    ]
    srs = _UNDEFINED_SRS
    geometries = [feature["geometry"] for feature in layer.features]
    if ground is not None:
        geometries = [_moved(geometry, lambda points: _on_ground(points, ground)) for geometry in geometries]
        code = ground.crs.to_epsg()
        srs = code or 100_000  # numbers from there are the writer's own
        named = (f"EPSG:{code}", srs, "EPSG") if code else ("the image's own", srs, "NONE")
        systems.append((*named, srs, ground.crs.to_wkt()))  # in the place of WGS 84 if it is that
    places = np.concatenate([np.empty((0, 2)), *(ring for geometry in geometries for ring in _rings(geometry))])
    extent = [*places.min(axis=0).tolist(), *places.max(axis=0).tolist()] if len(places) else [None] * 4
    columns = "".join(f", {name} {_COLUMN_TYPES.get(kind, 'DOUBLE')}" for name, kind in layer.columns.items())
    with closing(sqlite3.connect(path)) as file:
        file.executescript(_GPKG_TABLES)
        file.execute(f"CREATE TABLE {layer.name} (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom BLOB{columns})")
        file.execute(f"PRAGMA application_id = {_GPKG_ID}")
        file.execute(f"PRAGMA user_version = {_GPKG_VERSION}")
        file.executemany("INSERT OR REPLACE INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, NULL)", systems)
        file.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier, min_x, min_y, max_x, max_y, srs_id) "
            "VALUES (?, 'features', ?, ?, ?, ?, ?, ?)",
            (layer.name, layer.name, *extent, srs),
        )
        file.execute(
            "INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, 0, 0)", (layer.name, layer.kind.upper(), srs)
        )
        file.executemany(
            f"INSERT INTO {layer.name} (geom, {', '.join(layer.columns)}) VALUES (?{', ?' * len(layer.columns)})",
            [
                (_header(srs) + _wkb(geometry), *(feature["properties"][name] for name in layer.columns))
                for geometry, feature in zip(geometries, layer.features, strict=True)
            ],
        )
        file.commit()


def _header(srs: int) -> bytes:
    """What a GeoPackage puts before a geometry: here without an envelope, little endian."""
    return struct.pack("<2sBBi", b"GP", 0, 1, srs)


def _wkb(geometry: dict[str, Any]) -> bytes:
    """A geometry of GeoJSON as well-known binary, little endian."""
    kind, parts = geometry["type"], geometry["coordinates"]
    start = struct.pack("<BII", 1, _WKB_KINDS[kind], len(parts))
    if kind == "LineString":
        return start + np.array(parts, dtype="<f8").tobytes()
    if kind == "Polygon":
        return start + b"".join(struct.pack("<I", len(ring)) + np.array(ring, "<f8").tobytes() for ring in parts)
    return start + b"".join(_wkb({"type": "Polygon", "coordinates": rings}) for rings in parts)


def _rings(geometry: dict[str, Any]) -> list[NDArray[np.float64]]:
    """All runs of places of a geometry."""
    parts = geometry["coordinates"]
    if geometry["type"] == "LineString":
        parts = [parts]
    elif geometry["type"] == "MultiPolygon":
        parts = [ring for polygon in parts for ring in polygon]
    return [np.array(part, dtype=np.float64) for part in parts]


def _moved(geometry: dict[str, Any], move: Callable[[NDArray[np.float64]], NDArray[np.float64]]) -> dict[str, Any]:
    """The same geometry in other coordinates."""

    def moved(part: Any) -> Any:
        if isinstance(part[0][0], int | float):
            return move(np.array(part, dtype=np.float64)).tolist()
        return [moved(each) for each in part]

    return {**geometry, "coordinates": moved(geometry["coordinates"])}


def _on_ground(points: NDArray[np.float64], ground: Ground) -> NDArray[np.float64]:
    """Places ``[n, 2]`` in pixels as coordinates of the file's system."""
    a, b, c, d, e, f = ground.transform[:6]
    x, y = points[:, 0], points[:, 1]
    return np.column_stack([a * x + b * y + c, d * x + e * y + f])
