"""A JPEG larger than may be decoded whole is unpacked to the disk, strip by strip, and read from there."""

from __future__ import annotations

import shutil
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

import vehanchor
from tests.skill.imagery.files import pillow
from vehanchor.errors import ImageDecodeError, ImageTooLargeError, MissingExtraError
from vehanchor.imagery.formats.unpacked import _STRIP_ROWS
from vehanchor.imagery.raster import Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ImageLimits

SMALL = ImageLimits(max_pixels=20_000)
HEIGHT, WIDTH = 2 * _STRIP_ROWS + 90, 400


@pytest.fixture(scope="module")
def photo() -> np.ndarray:
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH]
    return np.stack([x % 251, y % 241, (x + y) % 239], axis=-1).astype(np.uint8)


@pytest.fixture(scope="module")
def jpeg(photo: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", photo, (cv2.IMWRITE_JPEG_QUALITY, 95))[1].tobytes()


def test_windows_of_it_are_those_of_the_picture_decoded_whole(jpeg: bytes, tmp_path: Path) -> None:
    (tmp_path / "large.jpg").write_bytes(jpeg)
    with open_raster(jpeg) as raster:
        whole = raster.read()
    for source in (jpeg, tmp_path / "large.jpg"):
        with open_raster(source, limits=SMALL) as raster:
            assert (raster.width_px, raster.height_px) == (WIDTH, HEIGHT)
            part = raster.read(Window(100, _STRIP_ROWS - 20, 200, 60))
            expected = whole[_STRIP_ROWS - 20 : _STRIP_ROWS + 40, 100:300]
            assert np.abs(part.astype(int) - expected).mean() < 3, "two decoders' ways with halved colours"


def test_it_is_turned_upright_and_measured_as_any_other(photo: np.ndarray) -> None:
    exif = Image.Exif()
    exif[274] = 6
    turned = pillow("JPEG", "RGB", photo, quality=95, subsampling=0, exif=exif.tobytes())
    with open_raster(turned) as whole, open_raster(turned, limits=SMALL) as windowed:
        assert (windowed.width_px, windowed.height_px) == (HEIGHT, WIDTH)
        assert np.abs(whole.read().astype(int) - windowed.read()).max() <= 3
    line = vehanchor.measure_distance(turned, [(0, 0), (600, 0)], gsd_m_per_px=0.1, limits=SMALL)
    assert line.distance_m == pytest.approx(60)


def test_without_rasterio_it_says_what_to_install_or_how_to_decode_it_whole(
    photo: np.ndarray, jpeg: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(MissingExtraError, match=r"vehanchor\[geo\]', or decode it whole with --max-megapixels 1$"):
        open_raster(jpeg, limits=SMALL)
    line = vehanchor.measure_distance(jpeg, [(0, 0), (400, 0)], gsd_m_per_px=0.1, limits=SMALL, max_megapixels=1)
    assert line.distance_m == pytest.approx(40)


def test_it_leaves_nothing_behind(jpeg: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    with open_raster(jpeg, limits=SMALL) as raster:
        raster.read(Window(0, 0, 50, 50))
        assert list(tmp_path.iterdir()) == []


def test_a_damaged_or_truncated_one_is_refused(jpeg: bytes) -> None:
    with pytest.raises(ImageDecodeError, match="truncated"):
        open_raster(jpeg[:-40], limits=SMALL)
    middle = len(jpeg) // 2
    with pytest.raises(ImageDecodeError):
        open_raster(jpeg[:middle] + jpeg[middle + 2000 :], limits=SMALL)


def test_the_disk_is_a_limit_too(jpeg: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ImageTooLargeError, match="--max-megapixels"):
        open_raster(jpeg, limits=ImageLimits(max_pixels=20_000, max_unpacked_bytes=3 * WIDTH * HEIGHT - 1))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 10**9, 10**5))
    with pytest.raises(ImageTooLargeError, match="free some space, set TMPDIR to another folder"):
        open_raster(jpeg, limits=SMALL)


def test_one_that_holds_its_whole_picture_while_it_is_decoded_is_refused_as_before(photo: np.ndarray) -> None:
    with pytest.raises(ImageTooLargeError, match="the JPEG declares"):
        open_raster(pillow("JPEG", "RGB", photo, progressive=True), limits=SMALL)


def test_colours_of_print_are_shown_as_when_it_is_decoded_whole(photo: np.ndarray) -> None:
    data = pillow("JPEG", "CMYK", photo, quality=95)
    with open_raster(data) as whole, open_raster(data, limits=SMALL) as windowed:
        assert np.abs(whole.read().astype(int) - windowed.read()).mean() < 6
