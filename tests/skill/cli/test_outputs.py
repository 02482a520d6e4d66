"""``vehanchor estimate --scale-bar --geotiff``: files in which people can measure."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from typer.testing import CliRunner

import vehanchor
from tests.models import blank_image, write_detector
from vehanchor.cli.app import app
from vehanchor.export.resample import why_not_resampled
from vehanchor.records import GsdEstimate, KnownPlane

LINE = ("--known-length", "100 100 500 100 40 measured")  # 0.1 m/px


@pytest.fixture
def image(tmp_path: Path) -> Path:
    pixels = blank_image(1000, 600)
    pixels[0, 0] += 1  # something can be seen
    assert cv2.imwrite(str(tmp_path / "image.png"), pixels)
    write_detector(tmp_path / "painted.onnx")
    return tmp_path / "image.png"


def run(image: Path, *arguments: object) -> tuple[int, str]:
    """Run ``vehanchor estimate``; return its status and stderr."""
    detector = image.with_name("painted.onnx")
    command = ["estimate", image, "--detector", detector, *arguments]
    result = CliRunner().invoke(app, [str(argument) for argument in command])
    return result.exit_code, result.stderr


def test_the_scale_bar_has_its_length(image: Path) -> None:
    out = image.with_name("out.png")
    assert run(image, "--scale-bar", out, *LINE) == (0, f"wrote {out}\n")
    before = cv2.imread(str(image))
    after = cv2.imread(str(out))
    assert before is not None
    assert after is not None
    assert after.shape == before.shape
    white = np.argwhere((after == 255).all(2) & (before != 255).any(2))
    rows = white[:, 0]
    bar_columns = white[rows > rows.max() - 3, 1]
    # The bar is 20 m long, a fifth of the picture's width.
    assert bar_columns.max() - bar_columns.min() == pytest.approx(200, abs=2)


def test_without_a_usable_scale_nothing_is_written(image: Path) -> None:
    out = image.with_name("out.png")
    copy = image.with_name("out.tif")
    code, err = run(image, "--scale-bar", out, "--geotiff", copy)
    assert code == 3
    last = err.splitlines()[-1]
    assert last.endswith("image.png: no scale bar and no GeoTIFF: there is no scale")
    assert not out.exists()
    assert not copy.exists()


@pytest.fixture
def usable(image: Path) -> GsdEstimate:
    """A record with a single usable scale."""
    return vehanchor.estimate_gsd(image, known_lengths=[(100, 100, 500, 100, 40, "measured")])


def test_a_single_usable_scale_is_not_refused(usable: GsdEstimate) -> None:
    assert why_not_resampled(usable) is None


def test_a_scale_that_varies_is_refused_with_the_tilt(usable: GsdEstimate) -> None:
    assert usable.scale is not None
    plane = KnownPlane(tilt_deg=35.0, roll_deg=0.0, focal_length_px=800.0)
    scale = usable.scale.model_copy(update={"plane": plane})
    tilted = usable.model_copy(update={"scale": scale})
    assert why_not_resampled(tilted) == "the camera was tilted by 35 degrees, and the scale varies"


def test_a_scale_of_low_confidence_is_refused(usable: GsdEstimate) -> None:
    unsure = usable.model_copy(update={"status": "low_confidence"})
    assert why_not_resampled(unsure) == "the scale is not usable"


def test_a_geotiff_has_all_pixels_in_local_metres(image: Path) -> None:
    photo = np.random.default_rng(3).integers(0, 255, (700, 1100, 3), np.uint8)
    assert cv2.imwrite(str(image), photo)
    copy = image.with_name("copy.tif")
    assert run(image, "--geotiff", copy, *LINE, "--rulers", "known_length") == (
        0,
        f"wrote {copy}\n",
    )
    with rasterio.open(copy) as written:
        assert np.array_equal(written.read().transpose(1, 2, 0), photo[:, :, ::-1])
        assert 'UNIT["metre",1' in written.crs.to_wkt()
        assert written.crs.to_epsg() is None, "the place on Earth is unknown"
        assert tuple(written.bounds) == pytest.approx((0, -70, 110, 0), rel=1e-3)


def test_boxes_have_their_sizes_in_metres(image: Path) -> None:
    out = image.with_name("boxes.geojson")
    add = ("--add", "300", "300", "345", "300")
    assert run(image, "--boxes", out, *LINE, *add)[0] == 0
    [vehicle] = json.loads(out.read_text())["features"]
    # The known line has 40 m on 400 px.
    assert vehicle["properties"]["length_m"] == pytest.approx(4.5, rel=0.1)


def test_details_show_the_metadata_that_were_read(image: Path) -> None:
    detector = image.with_name("painted.onnx")
    command = ["estimate", str(image), "--detector", str(detector), "--details"]
    output = CliRunner().invoke(app, command).stdout
    assert "metadata   none" in output
