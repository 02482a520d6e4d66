"""Files of boxes for other programs: GeoJSON and GeoPackage for maps, DOTA's text for training detectors.

Boxes of a georeferenced file are where they are on the ground; of any other image they are in its pixels, y down.
"""

from __future__ import annotations

import json
import os
import sqlite3
import struct
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vehanchor.detection.boxes import box_corners
from vehanchor.errors import OutputError
from vehanchor.output import whole_file

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.exhibits import ScaleAnalysis

__all__ = ["BOX_SUFFIXES", "check_boxes_path", "write_boxes"]

BOX_SUFFIXES = (".geojson", ".gpkg", ".txt")

_GPKG_ID, _GPKG_VERSION = 0x47504B47, 10300  # "GPKG", version 1.3
_UNDEFINED_SRS = -1  # of the standard: Cartesian, of no known place
_GPKG_TABLES = """
CREATE TABLE gpkg_spatial_ref_sys (srs_name TEXT NOT NULL, srs_id INTEGER NOT NULL PRIMARY KEY,
  organization TEXT NOT NULL, organization_coordsys_id INTEGER NOT NULL, definition TEXT NOT NULL, description TEXT);
CREATE TABLE gpkg_contents (table_name TEXT NOT NULL PRIMARY KEY, data_type TEXT NOT NULL, identifier TEXT UNIQUE,
  description TEXT DEFAULT '', last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
  min_x DOUBLE, min_y DOUBLE, max_x DOUBLE, max_y DOUBLE, srs_id INTEGER);
CREATE TABLE gpkg_geometry_columns (table_name TEXT NOT NULL PRIMARY KEY, column_name TEXT NOT NULL,
  geometry_type_name TEXT NOT NULL, srs_id INTEGER NOT NULL, z TINYINT NOT NULL, m TINYINT NOT NULL);
CREATE TABLE vehicles (fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, geom BLOB, kept BOOLEAN, score DOUBLE,
  length_px DOUBLE);
"""


class _Ground(NamedTuple):
    """Where a georeferenced file lies: its transform and its coordinate system, as rasterio has them."""

    transform: Any
    crs: Any


def check_boxes_path(path: str | Path) -> Path:
    """Make sure that boxes can be written there, before the work of finding them.

    Raises:
        OutputError: the suffix is none of ``BOX_SUFFIXES``, or the folder does not exist.
    """
    target = Path(path)
    if target.suffix.lower() not in BOX_SUFFIXES:
        raise OutputError(f"cannot write boxes as {str(path)!r}: use one of the suffixes {', '.join(BOX_SUFFIXES)}")
    if not target.parent.is_dir() or target.is_dir():
        raise OutputError(f"cannot write {str(path)!r}: name a file in a folder that exists")
    return target


def write_boxes(path: str | Path, analysis: ScaleAnalysis) -> Path:
    """Write the vehicles of an analysis in the form that the suffix says.

    Args:
        path: ``.geojson`` (degrees of WGS 84, as the format wants, for a georeferenced file), ``.gpkg`` (the file's own
            coordinate system), or ``.txt``, DOTA's lines of four corners, class and difficulty, always in pixels.
        analysis: of an image; only of a path is it known where on the ground it lies.

    Returns:
        The path.

    Raises:
        OutputError: see ``check_boxes_path``; or the file system refuses.
    """
    target = check_boxes_path(path)
    suffix = target.suffix.lower()
    with whole_file(target) as partial:
        if suffix == ".txt":
            partial.write_text(_dota(analysis), encoding="utf-8")
        elif suffix == ".geojson":
            partial.write_text(json.dumps(_geojson(analysis)), encoding="utf-8")
        else:
            _write_geopackage(partial, analysis)
    return target


def _dota(analysis: ScaleAnalysis) -> str:
    rows = box_corners(analysis.detections.boxes).reshape(-1, 8)
    return "".join(" ".join(f"{value:.1f}" for value in row) + " vehicle 0\n" for row in rows)


def _geojson(analysis: ScaleAnalysis) -> dict[str, Any]:
    collection = analysis.__geo_interface__
    ground = _ground(analysis)
    if ground is not None:
        from rasterio.warp import transform

        for feature in collection["features"]:
            (ring,) = feature["geometry"]["coordinates"]
            longitudes, latitudes = transform(ground.crs, "EPSG:4326", *_on_ground(np.array(ring), ground).T.tolist())
            feature["geometry"]["coordinates"] = [list(map(list, zip(longitudes, latitudes, strict=True)))]
    return collection


def _write_geopackage(path: Path, analysis: ScaleAnalysis) -> None:
    ground = _ground(analysis)
    corners = box_corners(analysis.detections.boxes)
    systems: list[tuple[str, int, str, int, str]] = [
        ("Undefined Cartesian", _UNDEFINED_SRS, "NONE", _UNDEFINED_SRS, "undefined"),
        ("Undefined geographic", 0, "NONE", 0, "undefined"),
    ]
    srs = _UNDEFINED_SRS
    if ground is not None:
        corners = _on_ground(corners.reshape(-1, 2), ground).reshape(corners.shape)
        srs = ground.crs.to_epsg() or 100_000  # numbers from there are the writer's own
        systems.append((f"EPSG:{srs}", srs, "EPSG", srs, ground.crs.to_wkt()))
    extent = [*corners.min(axis=(0, 1)).tolist(), *corners.max(axis=(0, 1)).tolist()] if len(corners) else [None] * 4
    with closing(sqlite3.connect(path)) as file:
        file.executescript(_GPKG_TABLES)
        file.execute(f"PRAGMA application_id = {_GPKG_ID}")
        file.execute(f"PRAGMA user_version = {_GPKG_VERSION}")
        file.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, NULL)", systems)
        file.execute(
            "INSERT INTO gpkg_contents (table_name, data_type, identifier, min_x, min_y, max_x, max_y, srs_id) "
            "VALUES ('vehicles', 'features', 'vehicles', ?, ?, ?, ?, ?)",
            (*extent, srs),
        )
        file.execute("INSERT INTO gpkg_geometry_columns VALUES ('vehicles', 'geom', 'POLYGON', ?, 0, 0)", (srs,))
        found = analysis.detections
        file.executemany(
            "INSERT INTO vehicles (geom, kept, score, length_px) VALUES (?, ?, ?, ?)",
            [
                (_polygon(ring, srs), bool(kept), float(score), float(length))
                for ring, kept, score, length in zip(
                    corners, analysis.kept, found.scores, found.boxes[:, 2], strict=True
                )
            ],
        )
        file.commit()


def _polygon(ring: NDArray[np.float64], srs: int) -> bytes:
    """A ring of four corners as the GeoPackage's binary: its header without an envelope, then WKB, little endian."""
    closed = np.concatenate([ring, ring[:1]]).astype("<f8")
    return struct.pack("<2sBBiBIII", b"GP", 0, 1, srs, 1, 3, 1, len(closed)) + closed.tobytes()


def _on_ground(points: NDArray[np.float64], ground: _Ground) -> NDArray[np.float64]:
    """Places ``[n, 2]`` in pixels as coordinates of the file's system."""
    a, b, c, d, e, f = ground.transform[:6]
    x, y = points[:, 0], points[:, 1]
    return np.column_stack([a * x + b * y + c, d * x + e * y + f])


def _ground(analysis: ScaleAnalysis) -> _Ground | None:
    """Where the image lies; None for one that is not georeferenced, or was no file."""
    if analysis.estimate.georeference_gsd_m_per_px is None or not isinstance(analysis.image, str | os.PathLike):
        return None
    import rasterio  # the file was read by it

    with rasterio.open(analysis.image) as dataset:
        return _Ground(dataset.transform, dataset.crs)
