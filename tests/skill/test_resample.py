"""Copies at another scale: pixels, metadata, georeference, and what is skipped."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import rasterio
from PIL import Image
from typer.testing import CliRunner

from tests.models import pool_among_cars, write_detector
from tests.skill.imagery.files import exif, geotiff, jpeg, smooth_rgb
from vehanchor import Engine
from vehanchor.cli.app import app
from vehanchor.errors import InvalidParameterError, OutputError
from vehanchor.export.resample import Resampled
from vehanchor.imagery.metadata.resized import metadata_of_copy
from vehanchor.imagery.raster import oriented

# 400 px are 40 m.
LINE: dict[str, Any] = {
    "known_lengths": [(100, 100, 500, 100, 40, "measured")],
    "rulers": ("known_length",),
}
IMAGE = smooth_rgb(600, 400)


def _resample(image: Any, gsd_m_per_px: float, **options: Any) -> Resampled:
    return Engine().resample(image, gsd_m_per_px=gsd_m_per_px, **LINE, **options)


# --- Pixels and facts


def test_the_copy_has_the_scale_that_is_asked_for() -> None:
    copy = _resample(IMAGE, 0.2)
    assert copy.pixels.shape == (200, 300, 3)
    assert copy.factor == pytest.approx(0.5)
    assert copy.gsd_m_per_px == pytest.approx(0.2, rel=0.02)


def test_the_scale_of_the_copy_is_that_of_its_whole_pixels() -> None:
    copy = _resample(IMAGE, 0.13)
    assert copy.scale.gsd_m_per_px is not None
    width_px = copy.pixels.shape[1]
    assert copy.gsd_m_per_px == pytest.approx(copy.scale.gsd_m_per_px * 600 / width_px)


def test_a_smaller_copy_is_averaged() -> None:
    stripes = np.zeros((400, 600, 3), np.uint8)
    stripes[:, ::2] = 200
    assert np.abs(_resample(stripes, 0.2).pixels.astype(int) - 100).max() <= 1


def test_a_larger_copy_is_smooth() -> None:
    copy = _resample(IMAGE, 0.06)
    assert copy.factor == pytest.approx(0.1 / 0.06, rel=0.02)
    assert np.abs(np.diff(copy.pixels[:, :, 0].astype(int), axis=1)).max() <= 3


def test_the_facts_have_the_interval_of_the_copy() -> None:
    copy = _resample(IMAGE, 0.2)
    facts = copy.facts
    assert facts["gsd_ci95_low_m_per_px"] < facts["gsd_m_per_px"] < facts["gsd_ci95_high_m_per_px"]
    assert facts["confidence"] == copy.scale.confidence
    assert facts["factor"] == copy.factor


def test_more_than_twice_must_be_allowed() -> None:
    with pytest.raises(InvalidParameterError, match="adds no detail: the limit is 2"):
        _resample(IMAGE, 0.04)
    assert _resample(IMAGE, 0.04, max_enlargement=3).factor == pytest.approx(2.5, rel=0.02)


def test_without_a_usable_scale_there_is_no_copy_but_advice() -> None:
    refused = "cannot be resampled: there is no scale, nothing can be seen in the image: send"
    with pytest.raises(InvalidParameterError, match=refused):
        Engine().resample(np.full((400, 600, 3), 90, np.uint8), gsd_m_per_px=0.1)


def test_a_georeferenced_photograph_has_the_scale_of_its_file(tmp_path: Path) -> None:
    transform = rasterio.transform.Affine(0.3, 0, 500_000, 0, -0.3, 5_000_000)
    source = geotiff(tmp_path / "map.tif", IMAGE, transform=transform)
    copy = Engine().resample(source, gsd_m_per_px=0.6)
    assert (copy.factor, copy.gsd_m_per_px) == pytest.approx((0.5, 0.6))
    assert copy.facts["scale_source"] == "file"


@pytest.mark.parametrize("gsd_m_per_px", [0, -1, float("nan")])
def test_a_bad_scale_is_refused(gsd_m_per_px: float) -> None:
    with pytest.raises(InvalidParameterError, match="gsd_m_per_px"):
        _resample(IMAGE, gsd_m_per_px)


def test_a_huge_copy_is_refused() -> None:
    with pytest.raises(InvalidParameterError, match="the limit is 240000"):
        _resample(IMAGE, 0.06, max_megapixels=0.24)


# --- Files


def _photo(folder: Path, tags: dict[str, Any]) -> Path:
    path = folder / "photo.jpg"
    path.write_bytes(jpeg(exif=exif(tags), width_px=600, height_px=400))
    return path


def test_a_jpeg_keeps_its_camera_and_has_true_sizes(tmp_path: Path) -> None:
    tags = {"PixelXDimension": 600, "FocalPlaneXResolution": 5000.0, "FocalLength": 8.8}
    source = _photo(tmp_path, tags)
    (tmp_path / "out").mkdir()
    copy = _resample(source, 0.2)
    path = copy.write(tmp_path / "out")
    assert path == tmp_path / "out" / "photo.jpg"
    with Image.open(path) as image:
        assert image.size == (300, 200)
        camera = image.getexif().get_ifd(0x8769)
    assert camera[0xA002] == 300
    assert float(camera[0xA20E]) == pytest.approx(2500, rel=1e-3)
    assert float(camera[0x920A]) == pytest.approx(8.8)


def test_the_facts_stand_beside_the_copy(tmp_path: Path) -> None:
    source = _photo(tmp_path, {})
    copy = _resample(source, 0.2)
    path = copy.write(tmp_path / "out")
    facts = json.loads(path.with_name("photo.jpg.json").read_text())
    assert facts == copy.facts


@pytest.mark.parametrize("orientation", [3, 6])
def test_a_turned_jpeg_becomes_upright(orientation: int) -> None:
    data = jpeg(exif=exif({"Orientation": orientation}), width_px=600, height_px=400)
    (block,) = metadata_of_copy(data, 300, 200, across=0.5, down=0.5)
    with Image.open(_in_jpeg(block)) as image:
        assert image.getexif()[274] == 1


def _in_jpeg(segment: bytes) -> Any:
    import io

    _, plain = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))
    data = plain.tobytes()
    return io.BytesIO(data[:2] + segment + data[2:])


@pytest.mark.parametrize("cut", range(4, 60, 7))
def test_damaged_metadata_are_left_out(cut: int) -> None:
    block = exif({"PixelXDimension": 600, "FocalPlaneXResolution": 5000.0})[:cut]
    segments = metadata_of_copy(jpeg(exif=block), 300, 200, across=0.5, down=0.5)
    assert len(segments) <= 1


def test_a_geotiff_keeps_its_place(tmp_path: Path) -> None:
    source = geotiff(tmp_path / "photo.tif", IMAGE)
    (tmp_path / "out").mkdir()
    path = _resample(source, 0.2).write(tmp_path / "out")
    with rasterio.open(source) as old, rasterio.open(path) as new:
        assert (new.width, new.height, new.crs) == (300, 200, old.crs)
        assert new.bounds == pytest.approx(old.bounds)
        assert new.res == pytest.approx((0.5, 0.5))


def test_a_geotiff_keeps_its_bands(tmp_path: Path) -> None:
    four = np.dstack([IMAGE, IMAGE[:, :, 0]]).astype(np.uint16) * 100
    source = geotiff(tmp_path / "photo.tif", four)
    (tmp_path / "out").mkdir()
    path = _resample(source, 0.2).write(tmp_path / "out")
    with rasterio.open(path) as file:
        assert (file.count, set(file.dtypes)) == (4, {"uint16"})
        halved = file.read(4)
    assert halved[100, 150] == pytest.approx(four[200, 300, 3], rel=0.02)


def test_a_grey_geotiff_stays_grey(tmp_path: Path) -> None:
    source = geotiff(tmp_path / "photo.tif", IMAGE[:, :, :1])
    (tmp_path / "out").mkdir()
    path = _resample(source, 0.2).write(tmp_path / "out")
    with rasterio.open(path) as file:
        assert (file.count, set(file.dtypes)) == (1, {"uint8"})


@pytest.mark.parametrize("mode", ["RGBA", "L"])
def test_eight_bit_colours_become_png(tmp_path: Path, mode: str) -> None:
    Image.fromarray(IMAGE).convert(mode).save(tmp_path / "photo.tif")
    (tmp_path / "out").mkdir()
    assert _resample(tmp_path / "photo.tif", 0.2).write(tmp_path / "out").name == "photo.png"


def test_a_geotiff_of_oblong_pixels_keeps_its_place(tmp_path: Path) -> None:
    transform = rasterio.Affine(0.2, 0, 500_000, 0, -0.1, 5_000_000)
    source = geotiff(tmp_path / "photo.tif", IMAGE, transform=transform)
    (tmp_path / "out").mkdir()
    path = _resample(source, 0.2).write(tmp_path / "out")
    with rasterio.open(source) as old, rasterio.open(path) as new:
        assert new.bounds == pytest.approx(old.bounds)


@pytest.mark.parametrize("suffix", [".tif", ".png"])
def test_sixteen_bits_stay_without_a_georeference(tmp_path: Path, suffix: str) -> None:
    deep = IMAGE.astype(np.uint16) * 200
    cv2.imwrite(str(tmp_path / f"photo{suffix}"), deep[:, :, ::-1])
    (tmp_path / "out").mkdir()
    path = _resample(tmp_path / f"photo{suffix}", 0.2).write(tmp_path / "out")
    assert path.name == "photo.tif"
    written = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert written is not None
    assert written.dtype == np.uint16
    assert written[100, 150, ::-1] == pytest.approx(deep[200, 300], rel=0.02)


@pytest.mark.parametrize("orientation", [1, 2, 3, 6, 8])
def test_bands_of_a_turned_file_become_upright(tmp_path: Path, orientation: int) -> None:
    deep = smooth_rgb(600, 600)[:, :, 0].astype(np.uint16) * 200
    image = Image.fromarray(deep)
    image.save(tmp_path / "photo.tif", tiffinfo={274: orientation})
    (tmp_path / "out").mkdir()
    path = _resample(tmp_path / "photo.tif", 0.2).write(tmp_path / "out")
    written = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert written is not None
    upright = np.ascontiguousarray(oriented(deep, orientation)).astype(float)
    expected = cv2.resize(upright, written.shape[::-1], interpolation=cv2.INTER_AREA)
    assert written.dtype == np.uint16
    assert np.abs(written - expected).max() <= 0.02 * expected.max()


def test_other_formats_become_png(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "photo.bmp"), IMAGE)
    (tmp_path / "out").mkdir()
    copy = _resample(tmp_path / "photo.bmp", 0.2)
    path = copy.write(tmp_path / "out")
    assert path.name == "photo.png"
    written = cv2.imread(str(path))
    assert written is not None
    assert np.array_equal(written[:, :, ::-1], copy.pixels)


def test_the_photograph_is_never_replaced(tmp_path: Path) -> None:
    source = _photo(tmp_path, {})
    before = source.read_bytes()
    with pytest.raises(OutputError, match="is the photograph itself"):
        _resample(source, 0.2).write(tmp_path)
    assert source.read_bytes() == before


# --- The command


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A photograph with cars, and one without."""
    photos = tmp_path / "photos"
    photos.mkdir()
    for name, n_cars in (("cars", 24), ("bare", 0)):
        cv2.imwrite(str(photos / f"{name}.png"), pool_among_cars(n_cars)[:, :, ::-1])
    write_detector(tmp_path / "painted.onnx")
    return tmp_path


def test_a_folder_has_a_table_and_names_what_is_skipped(folder: Path) -> None:
    out = folder / "out"
    arguments = ["resample", folder / "photos", "--to", 0.3, "--out", out]
    arguments += ["--detector", folder / "painted.onnx", "--rulers", "vehicles"]
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == 0, result.output
    assert "1 of 2 photographs resampled" in result.stderr
    assert "bare.png" in result.stderr
    with (out / "resampled.csv").open(newline="") as file:
        rows = {Path(row["photograph"]).name: row for row in csv.DictReader(file)}
    assert rows["cars.png"]["copy"] == "cars.png"
    assert float(rows["cars.png"]["gsd_m_per_px"]) == pytest.approx(0.3, rel=0.01)
    assert rows["bare.png"]["error_code"] == "invalid_parameter"
    assert (out / "cars.png").exists()
    assert not (out / "bare.png").exists()
