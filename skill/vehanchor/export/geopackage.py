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

from vehanchor.export.layer import PIXELS_WKT, moved, on_ground, rings

if TYPE_CHECKING:
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
_GPKG_TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY,
  organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
  description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER);
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL PRIMARY KEY, column_name TEXT NOT NULL,
  geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL);
"""


def write_geopackage(path: Path, layer: Layer, ground: Ground | None) -> None:
    """Write a layer in the reference system of the image, or in pixels without one."""
    systems: list[tuple[str, int, str, int, str]] = [
        ("Undefined Cartesian", _UNDEFINED_SRS, "NONE", _UNDEFINED_SRS, "undefined"),
        ("Undefined geographic", 0, "NONE", 0, "undefined"),
        ("WGS 84", 4326, "EPSG", 4326, _WGS84),
    ]
    srs = _CUSTOM_SRS
    geometries = [feature["geometry"] for feature in layer.features]
    if ground is not None:
        geometries = [moved(geometry, lambda points: on_ground(points, ground)) for geometry in geometries]
        code = ground.crs.to_epsg()
        srs = code or _CUSTOM_SRS
        named = (f"EPSG:{code}", srs, "EPSG") if code else ("the image's own", srs, "NONE")
        systems.append((*named, srs, ground.crs.to_wkt()))  # replaces the row of WGS 84 if it is the same
    else:
        systems.append(("Pixels of the image", srs, "NONE", srs, PIXELS_WKT))
    places = np.concatenate([np.empty((0, 2)), *(ring for geometry in geometries for ring in rings(geometry))])
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
