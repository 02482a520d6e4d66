"""GeoPackage 1.3 files, written with SQLite of the standard library.

A library (pyogrio, fiona) would add a second GDAL beside rasterio's and need work-arounds for pixels without a
reference system. The format is stable; the QGIS test reads the files with GDAL.
"""

from __future__ import annotations

import sqlite3
import struct
from contextlib import closing
from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.errors import OutputError
from vehanchor.export.layer import PIXELS_WKT, moved, on_ground, rings

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from vehanchor.export.layer import Layer
    from vehanchor.imagery.metadata.georeference import Ground

_WKB_KINDS = {"LineString": 2, "Polygon": 3, "MultiPolygon": 6}
_COLUMN_TYPES = {bool: "BOOLEAN", str: "TEXT"}  # all others are DOUBLE

_GPKG_ID, _GPKG_VERSION = 0x47504B47, 10300  # "GPKG", version 1.3
_UNDEFINED_SRS = -1  # of the standard: undefined Cartesian, in metres to GDAL
_CUSTOM_SRS = 100_000  # custom numbers begin here
_WGS84 = (  # required in every GeoPackage
    'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.0174532925199433],AUTHORITY["EPSG","4326"]]'
)
_SYSTEMS = (
    ("Undefined Cartesian", _UNDEFINED_SRS, "NONE", _UNDEFINED_SRS, "undefined"),
    ("Undefined geographic", 0, "NONE", 0, "undefined"),
    ("WGS 84", 4326, "EPSG", 4326, _WGS84),
)
_INSERT_SYSTEM = "INSERT OR REPLACE INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, NULL)"
_GPKG_TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY,
  organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
  description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER);
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL PRIMARY KEY, column_name TEXT NOT NULL,
  geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL);
"""


def write_geopackage(path: Path, layers: Sequence[Layer]) -> None:
    """Write layers in the reference system of their images, or in pixels; those of one name share a table."""
    names = dict.fromkeys(layer.name for layer in layers)
    with closing(sqlite3.connect(path)) as file:
        file.executescript(_GPKG_TABLES)
        file.execute(f"PRAGMA application_id = {_GPKG_ID}")
        file.execute(f"PRAGMA user_version = {_GPKG_VERSION}")
        for row in _SYSTEMS:
            file.execute(_INSERT_SYSTEM, row)
        for name in names:
            _write_table(file, [layer for layer in layers if layer.name == name])
        file.commit()


def _write_table(file: sqlite3.Connection, layers: Sequence[Layer]) -> None:
    first = layers[0]
    srs = _register_system(file, first.ground)
    rows = []
    for layer in layers:
        if (layer.ground and layer.ground.crs) != (first.ground and first.ground.crs):
            raise OutputError("the images have different reference systems: write .geojson, or one file for each")
        rows += [(_geometry(feature["geometry"], layer.ground), feature["properties"]) for feature in layer.features]
    places = np.concatenate([np.empty((0, 2)), *(ring for geometry, _ in rows for ring in rings(geometry))])
    extent = [*places.min(axis=0).tolist(), *places.max(axis=0).tolist()] if len(places) else [None] * 4
    columns = "".join(f", {name} {_COLUMN_TYPES.get(kind, 'DOUBLE')}" for name, kind in first.columns.items())
    file.execute(f"CREATE TABLE {first.name} (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom BLOB{columns})")
    file.execute(
        "INSERT INTO gpkg_contents (table_name, data_type, identifier, min_x, min_y, max_x, max_y, srs_id) "
        "VALUES (?, 'features', ?, ?, ?, ?, ?, ?)",
        (first.name, first.name, *extent, srs),
    )
    file.execute(
        "INSERT INTO gpkg_geometry_columns VALUES (?, 'geom', ?, ?, 0, 0)", (first.name, first.kind.upper(), srs)
    )
    file.executemany(
        f"INSERT INTO {first.name} (geom, {', '.join(first.columns)}) VALUES (?{', ?' * len(first.columns)})",
        [(_header(srs) + _wkb(geometry), *(values[name] for name in first.columns)) for geometry, values in rows],
    )


def _register_system(file: sqlite3.Connection, ground: Ground | None) -> int:
    """Add the reference system of an image; return its number."""
    if ground is None:
        file.execute(_INSERT_SYSTEM, ("Pixels of the image", _CUSTOM_SRS, "NONE", _CUSTOM_SRS, PIXELS_WKT))
        return _CUSTOM_SRS
    code = ground.crs.to_epsg()
    srs: int = code or _CUSTOM_SRS
    named = (f"EPSG:{code}", srs, "EPSG") if code else ("the image's own", srs, "NONE")
    file.execute(_INSERT_SYSTEM, (*named, srs, ground.crs.to_wkt()))  # replaces the row of WGS 84 if it is the same
    return srs


def _geometry(geometry: dict[str, Any], ground: Ground | None) -> dict[str, Any]:
    return geometry if ground is None else moved(geometry, lambda points: on_ground(points, ground))


def _header(srs: int) -> bytes:
    """Make the header of a geometry: little endian, without an envelope."""
    return struct.pack("<2sBBi", b"GP", 0, 1, srs)


def _wkb(geometry: dict[str, Any]) -> bytes:
    """Encode a GeoJSON geometry as well-known binary, little endian."""
    kind, parts = geometry["type"], geometry["coordinates"]
    start = struct.pack("<BII", 1, _WKB_KINDS[kind], len(parts))
    if kind == "LineString":
        return start + np.array(parts, dtype="<f8").tobytes()
    if kind == "Polygon":
        return start + b"".join(struct.pack("<I", len(ring)) + np.array(ring, "<f8").tobytes() for ring in parts)
    return start + b"".join(_wkb({"type": "Polygon", "coordinates": rings}) for rings in parts)
