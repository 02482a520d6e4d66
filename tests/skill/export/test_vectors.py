"""Boxes in files that maps and trainings read."""

from __future__ import annotations

import json
import sqlite3
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine
from rasterio.warp import transform
from typer.testing import CliRunner

from tests.models import blank_image, paint_vehicles, write_detector
from vehanchor import Detector, ScaleAnalysis, analyse_area, analyse_scale
from vehanchor.cli.app import app
from vehanchor.detection.boxes import box_corners
from vehanchor.errors import OutputError
from vehanchor.export.layer import PIXELS_WKT
from vehanchor.export.vectors import write_boxes, write_measured

AFFINE = Affine(0.15, 0, 500_000, 0, -0.15, 5_000_000)


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_detector(tmp_path_factory.mktemp("models") / "m.onnx", fixed_size=256)


@pytest.fixture(scope="module")
def cars() -> np.ndarray:
    image = blank_image(400, 300)
    paint_vehicles(image, [(50 + 60 * (i % 6), 60 + 80 * (i // 6), 30 + i % 3, 13, 0.4) for i in range(12)])
    return image


@pytest.fixture(scope="module")
def on_ground(cars: np.ndarray, model: Path, tmp_path_factory: pytest.TempPathFactory) -> ScaleAnalysis:
    path = tmp_path_factory.mktemp("geo") / "a.tif"
    profile = {"driver": "GTiff", "width": 400, "height": 300, "count": 3, "dtype": "uint8", "photometric": "RGB"}
    with rasterio.open(path, "w", **profile, crs="EPSG:32633", transform=AFFINE) as dataset:
        dataset.write(cars.transpose(2, 0, 1))
    return analyse_scale(path, detector=Detector(model))


def expected_corners(analysis: ScaleAnalysis) -> np.ndarray:
    """Of all boxes, metres of the file's system."""
    corners = box_corners(analysis.detections.boxes)
    return np.stack([500_000 + 0.15 * corners[..., 0], 5_000_000 - 0.15 * corners[..., 1]], axis=-1)


def test_geojson_of_a_georeferenced_file_is_in_degrees(on_ground: ScaleAnalysis, tmp_path: Path) -> None:
    collection = json.loads(write_boxes(tmp_path / "a.geojson", on_ground).read_text())
    assert len(collection["features"]) == 12
    for feature, corners in zip(collection["features"], expected_corners(on_ground), strict=True):
        (ring,) = feature["geometry"]["coordinates"]
        expected = np.transpose(transform("EPSG:32633", "EPSG:4326", *corners.T.tolist()))
        np.testing.assert_allclose(ring[:4], expected, atol=1e-9)


def test_geojson_of_a_plain_image_is_in_its_pixels(cars: np.ndarray, model: Path, tmp_path: Path) -> None:
    analysis = analyse_scale(cars, detector=Detector(model))
    written = json.loads(write_boxes(tmp_path / "a.geojson", analysis).read_text())
    assert written.pop("crs") == {"type": "name", "properties": {"name": PIXELS_WKT}}
    assert written == json.loads(json.dumps(analysis.__geo_interface__))


def test_a_geopackage_of_a_plain_image_says_that_its_unit_is_the_pixel(
    cars: np.ndarray, model: Path, tmp_path: Path
) -> None:
    with sqlite3.connect(write_boxes(tmp_path / "a.gpkg", analyse_scale(cars, detector=Detector(model)))) as file:
        ((srs,),) = file.execute("SELECT srs_id FROM gpkg_contents")
        ((definition,),) = file.execute("SELECT definition FROM gpkg_spatial_ref_sys WHERE srs_id = ?", (srs,))
    assert definition == PIXELS_WKT
    assert 'UNIT["pixel",1' in rasterio.CRS.from_wkt(definition).to_wkt()  # as GDAL reads it


def test_a_geopackage_has_the_tables_of_the_standard_and_polygons_in_the_files_system(
    on_ground: ScaleAnalysis, tmp_path: Path
) -> None:
    path = write_boxes(tmp_path / "a.gpkg", on_ground)
    with sqlite3.connect(path) as file:
        assert file.execute("PRAGMA application_id").fetchone() == (0x47504B47,)
        assert file.execute("SELECT srs_id FROM gpkg_contents").fetchone() == (32633,)
        assert file.execute("SELECT column_name, srs_id FROM gpkg_geometry_columns").fetchone() == ("geom", 32633)
        systems = dict(file.execute("SELECT srs_id, definition FROM gpkg_spatial_ref_sys"))
        rows = file.execute("SELECT geom, kept, score FROM vehicles ORDER BY fid").fetchall()
    assert rasterio.CRS.from_wkt(systems[32633]).to_epsg() == 32633
    assert set(systems) == {-1, 0, 4326, 32633}  # the first three are the standard's own
    assert rasterio.CRS.from_wkt(systems[4326]).to_epsg() == 4326
    assert len(rows) == 12
    for (geometry, kept, _), corners in zip(rows, expected_corners(on_ground), strict=True):
        magic, _, _, srs, order, kind, rings, n = struct.unpack("<2sBBiBIII", geometry[:21])
        assert (magic, srs, order, kind, rings, n, kept) == (b"GP", 32633, 1, 3, 1, 5, 1)
        ring = np.frombuffer(geometry[21:], "<f8").reshape(5, 2)
        np.testing.assert_allclose(ring, [*corners, corners[0]])


def test_dotas_text_is_in_pixels(on_ground: ScaleAnalysis, tmp_path: Path) -> None:
    lines = write_boxes(tmp_path / "a.txt", on_ground).read_text().splitlines()
    numbers = np.array([line.split()[:8] for line in lines], float).reshape(-1, 4, 2)
    np.testing.assert_allclose(numbers, box_corners(on_ground.detections.boxes), atol=0.051)
    assert {line.split(maxsplit=8)[8] for line in lines} == {"vehicle 0"}


def test_an_image_without_vehicles_has_files_without_boxes(model: Path, tmp_path: Path) -> None:
    analysis = analyse_scale(blank_image(200, 100), detector=Detector(model))
    assert json.loads(write_boxes(tmp_path / "a.geojson", analysis).read_text())["features"] == []
    assert write_boxes(tmp_path / "a.txt", analysis).read_text() == ""
    with sqlite3.connect(write_boxes(tmp_path / "a.gpkg", analysis)) as file:
        assert file.execute("SELECT count(*) FROM vehicles").fetchone() == (0,)


def test_the_command_writes_them_and_refuses_before_the_work(cars: np.ndarray, model: Path, tmp_path: Path) -> None:
    image = tmp_path / "photo.png"
    cv2.imwrite(str(image), cars[:, :, ::-1])
    words = ["estimate", str(image), "--detector", str(model), "--boxes"]
    assert CliRunner().invoke(app, [*words, str(tmp_path / "{stem}.txt")]).exit_code == 0
    assert len((tmp_path / "photo.txt").read_text().splitlines()) == 12
    refused = CliRunner().invoke(app, [*words, str(tmp_path / "boxes.shp")])
    assert (refused.exit_code, ".geojson, .gpkg, .txt" in refused.stderr) == (2, True)
    with pytest.raises(OutputError, match="folder that exists"):
        write_boxes(tmp_path / "none" / "a.txt", analyse_scale(cars, detector=Detector(model)))


def _run(*arguments: object) -> None:
    result = CliRunner().invoke(app, list(map(str, arguments)))
    assert result.exit_code == 0, result.output


def test_a_measured_line_is_written_where_it_lies_with_its_metres(on_ground: ScaleAnalysis, tmp_path: Path) -> None:
    for name in ("line.gpkg", "line.geojson"):
        points = ("--point", 10, 20, "--point", 110, 20, "--gsd", 0.15)
        _run("distance", on_ground.image, *points, "--line", tmp_path / name)
    with sqlite3.connect(tmp_path / "line.gpkg") as file:
        ((blob, status, metres, gsd),) = file.execute("SELECT geom, status, distance_m, gsd_m_per_px FROM lines")
        ((kind, srs),) = file.execute("SELECT geometry_type_name, srs_id FROM gpkg_geometry_columns")
    assert (status, kind, srs) == ("ok", "LINESTRING", 32633)
    assert (metres, gsd) == (pytest.approx(15), 0.15)
    assert struct.unpack("<2sBBiBII4d", blob) == (
        *(b"GP", 0, 1, 32633, 1, 2, 2),
        *(500_000 + 0.15 * 10, 5_000_000 - 0.15 * 20, 500_000 + 0.15 * 110, 5_000_000 - 0.15 * 20),
    )
    (feature,) = json.loads((tmp_path / "line.geojson").read_text())["features"]
    expected = np.transpose(transform("EPSG:32633", "EPSG:4326", [500_001.5, 500_016.5], [4_999_997] * 2))
    np.testing.assert_allclose(feature["geometry"]["coordinates"], expected, atol=1e-9)
    assert feature["properties"]["distance_m"] == pytest.approx(15)


def test_a_line_is_no_box(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["distance", "a.jpg", "--point", "1", "1", "--line", str(tmp_path / "a.txt")])
    assert result.exit_code != 0
    assert "use one of the suffixes .geojson, .gpkg" in " ".join(result.output.split())


def test_a_measured_outline_is_written_in_every_form(tmp_path: Path) -> None:
    image = np.full((200, 300, 3), 90, np.uint8)
    cv2.rectangle(image, (80, 60), (219, 139), (230, 230, 230), -1)  # 140 x 80 px
    cv2.imwrite(str(tmp_path / "roof.png"), image)
    target = ("--box", 75, 55, 225, 145, "--gsd", 0.1)
    for name in ("roof.gpkg", "roof.geojson", "roof.txt"):
        _run("measure", tmp_path / "roof.png", *target, "--outline", tmp_path / name)
    (feature,) = json.loads((tmp_path / "roof.geojson").read_text())["features"]
    assert feature["geometry"]["type"] == "MultiPolygon"
    assert feature["properties"]["area_m2"] == pytest.approx(112, rel=0.05)
    with sqlite3.connect(tmp_path / "roof.gpkg") as file:
        ((blob, area),) = file.execute("SELECT geom, area_m2 FROM outlines")
        ((kind, srs),) = file.execute("SELECT geometry_type_name, srs_id FROM gpkg_geometry_columns")
    assert (kind, srs, area) == ("MULTIPOLYGON", 100_000, feature["properties"]["area_m2"])
    _, _, _, _, order, code, n_polygons, ring_order, ring_code, n_rings, n = struct.unpack_from("<2sBBiBIIBIII", blob)
    assert (order, code, n_polygons, ring_order, ring_code, n_rings) == (1, 6, 1, 1, 3, 1)
    ring = np.frombuffer(blob, "<f8", offset=struct.calcsize("<2sBBiBIIBIII")).reshape(n, 2)
    np.testing.assert_allclose(ring, feature["geometry"]["coordinates"][0][0])
    *corners, category, difficult = (tmp_path / "roof.txt").read_text().split()
    assert (category, difficult) == ("object", "0")
    places = np.array(corners, float).reshape(4, 2)
    np.testing.assert_allclose([places.min(axis=0), places.max(axis=0)], [(80, 60), (220, 140)], atol=3)


def test_an_outline_is_written_of_whatever_was_measured_without_reading_the_image_again(
    tmp_path: Path,
) -> None:
    """It was read again, within the default limits, whatever the caller's were."""
    image = np.full((200, 300, 3), 90, np.uint8)
    cv2.rectangle(image, (80, 60), (219, 139), (230, 230, 230), -1)
    cv2.imwrite(str(tmp_path / "roof.png"), image)
    analysis = analyse_area(
        tmp_path / "roof.png",
        box=(75, 55, 225, 145),
        gsd_m_per_px=0.1,
    )
    (tmp_path / "roof.png").unlink()
    (feature,) = json.loads(write_measured(tmp_path / "roof.geojson", analysis).read_text())["features"]
    assert feature == json.loads(json.dumps(analysis.__geo_interface__))
