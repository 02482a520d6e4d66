"""Boxes, outlines and lines in GeoJSON."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine
from rasterio.warp import transform
from typer.testing import CliRunner

from tests.models import blank_image, paint_vehicles, write_detector
from vehanchor import analyse_scale
from vehanchor.analysis.scale import ScaleAnalysis
from vehanchor.cli.app import app
from vehanchor.detection.boxes import box_corners
from vehanchor.detection.detector import Detector
from vehanchor.errors import OutputError
from vehanchor.export.geojson import PIXELS_WKT, write_boxes

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


def test_the_command_writes_them_and_refuses_before_the_work(cars: np.ndarray, model: Path, tmp_path: Path) -> None:
    image = tmp_path / "photo.png"
    cv2.imwrite(str(image), cars[:, :, ::-1])
    words = ["estimate", str(image), "--detector", str(model), "--boxes"]
    assert CliRunner().invoke(app, [*words, str(tmp_path / "{stem}.geojson")]).exit_code == 0
    assert len(json.loads((tmp_path / "photo.geojson").read_text())["features"]) == 12
    refused = CliRunner().invoke(app, [*words, str(tmp_path / "boxes.gpkg")])
    assert (refused.exit_code, "use the suffix .geojson" in refused.stderr) == (2, True)
    with pytest.raises(OutputError, match="folder that exists"):
        write_boxes(tmp_path / "none" / "a.geojson", analyse_scale(cars, detector=Detector(model)))


def _run(*arguments: object) -> None:
    result = CliRunner().invoke(app, list(map(str, arguments)))
    assert result.exit_code == 0, result.output


def test_a_measured_line_is_written_where_it_lies_with_its_metres(on_ground: ScaleAnalysis, tmp_path: Path) -> None:
    points = ("--point", 10, 20, "--point", 110, 20, "--gsd", 0.15)
    _run("distance", on_ground.image, *points, "--line", tmp_path / "line.geojson")
    (feature,) = json.loads((tmp_path / "line.geojson").read_text())["features"]
    expected = np.transpose(transform("EPSG:32633", "EPSG:4326", [500_001.5, 500_016.5], [4_999_997] * 2))
    np.testing.assert_allclose(feature["geometry"]["coordinates"], expected, atol=1e-9)
    facts = feature["properties"]
    assert (facts["status"], facts["distance_m"], facts["gsd_m_per_px"]) == ("ok", pytest.approx(15), 0.15)


def test_a_measured_outline_is_written_with_its_size(tmp_path: Path) -> None:
    image = np.full((200, 300, 3), 90, np.uint8)
    cv2.rectangle(image, (80, 60), (219, 139), (230, 230, 230), -1)  # 140 x 80 px
    cv2.imwrite(str(tmp_path / "roof.png"), image)
    target = ("--box", 75, 55, 225, 145, "--gsd", 0.1)
    _run("measure", tmp_path / "roof.png", *target, "--outline", tmp_path / "roof.geojson")
    (feature,) = json.loads((tmp_path / "roof.geojson").read_text())["features"]
    assert feature["geometry"]["type"] == "MultiPolygon"
    assert feature["properties"]["area_m2"] == pytest.approx(112, rel=0.05)
    places = np.array(feature["geometry"]["coordinates"][0][0], float)
    np.testing.assert_allclose([places.min(axis=0), places.max(axis=0)], [(80, 60), (220, 140)], atol=3)
