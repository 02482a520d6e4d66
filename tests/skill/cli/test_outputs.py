"""``vehanchor estimate --scale-bar --geotiff``: files in which people measure."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from typer.testing import CliRunner

import vehanchor
from tests.models import blank_image, write_detector
from vehanchor.cli.app import app
from vehanchor.cli.outputs import refusal
from vehanchor.records import KnownPlane

LINE = ("--known-length", "100 100 500 100 40 measured")  # 0.1 m/px


@pytest.fixture
def image(tmp_path: Path) -> Path:
    assert cv2.imwrite(str(tmp_path / "image.png"), blank_image(1000, 600))
    write_detector(tmp_path / "painted.onnx")
    return tmp_path / "image.png"


def run(image: Path, *arguments: object) -> tuple[int, str]:
    words = ["estimate", image, "--detector", image.with_name("painted.onnx"), *arguments]
    result = CliRunner().invoke(app, list(map(str, words)))
    return result.exit_code, result.stderr


def test_the_bar_is_as_long_as_it_says(image: Path) -> None:
    out = image.with_name("out.png")
    assert run(image, "--scale-bar", out, *LINE) == (0, "")
    before = cv2.imread(str(image))
    after = cv2.imread(str(out))
    assert before is not None
    assert after is not None
    assert after.shape == before.shape
    white = np.argwhere((after == 255).all(2) & (before != 255).any(2))
    bar = white[white[:, 0] > white[:, 0].max() - 3]
    # 20 m, a fifth of the picture's width
    assert bar[:, 1].max() - bar[:, 1].min() == pytest.approx(200, abs=2)


def test_without_a_usable_scale_nothing_is_written(image: Path) -> None:
    out = image.with_name("out.png")
    copy = image.with_name("out.tif")
    code, told = run(image, "--scale-bar", out, "--geotiff", copy)
    assert (
        code,
        told.splitlines()[-1].endswith("image.png: no scale bar and no GeoTIFF: there is no scale"),
    ) == (
        3,
        True,
    )
    assert not out.exists()
    assert not copy.exists()


def test_a_scale_that_varies_or_is_unsure_is_refused_with_the_reason(image: Path) -> None:
    record = vehanchor.estimate_gsd(image, known_lengths=[(100, 100, 500, 100, 40, "measured")])
    assert refusal(record) is None
    assert record.scale is not None
    plane = KnownPlane(tilt_deg=35.0, roll_deg=0.0, focal_length_px=800.0)
    tilted = record.model_copy(update={"scale": record.scale.model_copy(update={"plane": plane})})
    assert refusal(tilted) == "the camera was tilted by 35 degrees, and the scale varies"
    unsure = record.model_copy(update={"status": "low_confidence"})
    assert refusal(unsure) == "the scale is not usable"


def test_a_copy_in_local_metres_is_the_whole_picture_with_the_size_of_its_pixels(
    image: Path,
) -> None:
    photo = np.random.default_rng(3).integers(0, 255, (700, 1100, 3), np.uint8)
    assert cv2.imwrite(str(image), photo)
    copy = image.with_name("copy.tif")
    assert run(image, "--geotiff", copy, *LINE, "--rulers", "known_length") == (0, "")
    with rasterio.open(copy) as written:
        assert np.array_equal(written.read().transpose(1, 2, 0), photo[:, :, ::-1])
        assert 'UNIT["metre",1' in written.crs.to_wkt()
        assert written.crs.to_epsg() is None  # nobody knows where on Earth
        assert tuple(written.bounds) == pytest.approx((0, -70, 110, 0), rel=1e-3)
