from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

import vehanchor
from tests.models import blank_image, write_detector
from vehanchor.cli.app import app
from vehanchor.imagery.identity import image_id
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.records import KnownPlane, KnownScale


def run(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["scalebar", *(str(each) for each in arguments)])
    return result.exit_code, result.stderr


@pytest.fixture
def image(tmp_path: Path) -> Path:
    assert cv2.imwrite(str(tmp_path / "image.png"), blank_image(1000, 600))
    return tmp_path / "image.png"


def test_the_bar_is_as_long_as_it_says(image: Path) -> None:
    out = image.with_name("out.png")
    assert run(image, "-o", out, "--gsd", "0.1") == (0, "")
    before, after = cv2.imread(str(image)), cv2.imread(str(out))
    assert before is not None
    assert after is not None
    assert after.shape == before.shape
    white = np.argwhere((after == 255).all(2) & (before != 255).any(2))
    bar = white[white[:, 0] > white[:, 0].max() - 3]
    assert bar[:, 1].max() - bar[:, 1].min() == pytest.approx(200, abs=2)  # 20 m, a fifth of the picture's width


def test_without_a_usable_scale_nothing_is_written(image: Path, tmp_path: Path) -> None:
    out = image.with_name("out.png")
    code, told = run(image, "-o", out, "--detector", write_detector(tmp_path / "painted.onnx"))
    assert (code, told.strip()) == (3, "no bar: there is no scale; nothing was written")
    assert not out.exists()


def test_of_a_camera_that_looked_aside_no_bar_holds(image: Path) -> None:
    with open_raster(str(image)) as raster:
        plane = KnownPlane(tilt_deg=35.0, roll_deg=0.0, focal_length_px=800.0)
        facts = {"gsd_ci95_low_m_per_px": 0.09, "gsd_ci95_high_m_per_px": 0.11, "confidence": 0.9}
        known = KnownScale(gsd_m_per_px=0.1, image_id=image_id(raster), model_id="0" * 12, plane=plane, **facts)
    scale, out = image.with_name("scale.json"), image.with_name("out.png")
    scale.write_text(known.model_dump_json())
    code, told = run(image, "-o", out, "--scale", scale)
    assert code == 3
    assert told.strip() == "no bar: the camera was tilted by 35 degrees, and the scale varies; nothing was written"
    assert not out.exists()


def test_the_image_itself_is_never_overwritten(image: Path) -> None:
    code, told = run(image, "-o", image, "--gsd", "0.1")
    assert code == 2
    assert "is the image itself" in told


def test_a_copy_in_local_metres_is_the_whole_picture_with_the_size_of_its_pixels(tmp_path: Path) -> None:
    import rasterio

    photo = np.random.default_rng(3).integers(0, 255, (700, 1100, 3), np.uint8)
    assert cv2.imwrite(str(tmp_path / "photo.png"), photo)
    copy = tmp_path / "copy.tif"
    assert run(tmp_path / "photo.png", "-o", tmp_path / "bar.png", "--gsd", "0.125", "--geotiff", copy) == (0, "")
    with rasterio.open(copy) as written:
        assert np.array_equal(written.read().transpose(1, 2, 0), photo[:, :, ::-1])
        assert 'UNIT["metre",1' in written.crs.to_wkt()
        assert written.crs.to_epsg() is None  # nobody knows where on Earth
        assert tuple(written.bounds) == pytest.approx((0, -87.5, 137.5, 0))
    assert vehanchor.measure_distance(copy, [(0, 0), (80, 0)], gsd_m_per_px=0.125).distance_m == pytest.approx(10)


def test_a_copy_that_cannot_be_is_refused_before_the_work(image: Path) -> None:
    out = image.with_name("out.png")
    code, told = run(image, "-o", out, "--gsd", "0.1", "--geotiff", image.with_name("copy.png"))
    assert (code, "use .tif or .tiff" in told) == (2, True)
    assert not out.exists()
