from __future__ import annotations

import io
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from tests.skill.imagery.files import (
    HEIGHT_PX,
    JPEG,
    PNG,
    RGB,
    TRUNCATABLE,
    WIDTH_PX,
    WITH_THUMBNAIL,
    encoded,
    geotiff,
    jpeg_with,
    pillow,
    read_all,
    without_rasterio,
)
from vehanchor.errors import (
    ImageDecodeError,
    ImageFormatError,
)
from vehanchor.imagery.sources.opening import open_raster


@pytest.mark.parametrize(
    ("data", "tolerance"),
    [
        (encoded(".png"), 0),
        (encoded(".bmp"), 0),
        (encoded(".tif"), 0),
        (encoded(".webp", RGB, cv2.IMWRITE_WEBP_QUALITY, 101), 0),
        (encoded(".webp", RGB, cv2.IMWRITE_WEBP_QUALITY, 95), 12),
        (encoded(".jpg", RGB, cv2.IMWRITE_JPEG_QUALITY, 98), 6),
        (encoded(".jpg", RGB, cv2.IMWRITE_JPEG_QUALITY, 98, cv2.IMWRITE_JPEG_PROGRESSIVE, 1), 6),
        (encoded(".jpg", RGB, cv2.IMWRITE_JPEG_QUALITY, 98, cv2.IMWRITE_JPEG_RST_INTERVAL, 2), 6),
        (pillow("JPEG", "CMYK", quality=98), 8),
        (pillow("PNG", "RGBA"), 0),
        (pillow("WEBP", "RGBA", lossless=True), 0),
        (pillow("TIFF", "RGBA"), 0),
        (pillow("TIFF", "RGB", compression="tiff_lzw"), 0),
        (pillow("TIFF", "RGB", compression="jpeg", quality=98), 6),
        (pillow("TIFF", "YCbCr", compression="jpeg", quality=98), 8),
    ],
    ids=lambda value: None if isinstance(value, bytes) else str(value),
)
def test_every_format_gives_the_same_rgb(data: bytes, tolerance: int) -> None:
    difference = np.abs(read_all(data).astype(int) - RGB)
    assert difference.max() <= tolerance


@pytest.mark.parametrize("format_name", ["PNG", "BMP", "TIFF"])
@pytest.mark.parametrize("mode", ["L", "P", "1"])
def test_grey_palette_and_bilevel_become_three_bands(format_name: str, mode: str) -> None:
    data = pillow(format_name, mode)
    expected = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
    np.testing.assert_array_equal(read_all(data), expected)


@pytest.mark.parametrize("depth", [8, 16])
def test_a_tiff_whose_white_is_zero_is_shown_as_seen_or_refused(depth: int, tmp_path: Path) -> None:
    grey = RGB[..., :1].astype(f"u{depth // 8}")
    path = geotiff(tmp_path / "grey.tif", grey, photometric="MINISWHITE", crs=None, transform=None)
    if depth == 8:
        np.testing.assert_array_equal(read_all(path)[..., 0], 255 - grey[..., 0])
    else:
        with pytest.raises(ImageFormatError, match="photometric interpretation 0"):
            open_raster(path)


def test_opencv_and_this_code_agree_on_jpeg_orientation() -> None:
    for orientation in range(1, 9):
        data = jpeg_with(orientation, ">")
        theirs = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert theirs is not None
        np.testing.assert_array_equal(read_all(data), theirs[..., ::-1])


def test_files_of_floats_and_sixteen_bit_alpha_are_read_in_rgb_order(tmp_path: Path) -> None:
    unit = (RGB / 255).astype(np.float32)
    plain = geotiff(tmp_path / "a.tif", unit, crs=None, transform=None, photometric="RGB")
    with without_rasterio():
        np.testing.assert_array_equal(read_all(plain), RGB)
    alpha = np.full((HEIGHT_PX, WIDTH_PX, 1), 65535)
    bgra = np.concatenate([RGB[..., ::-1].astype(np.uint16) * 257, alpha], axis=2).astype(np.uint16)
    data = cv2.imencode(".png", bgra)[1].tobytes()
    np.testing.assert_array_equal(read_all(data), read_all(RGB.astype(np.uint16) * 257))


@pytest.mark.parametrize("share", [0.001, 0.02, 0.2, 0.5, 0.9, 0.99])
@pytest.mark.parametrize("name", TRUNCATABLE)
def test_a_truncated_file_is_not_measured(name: str, share: float, capfd: pytest.CaptureFixture[str]) -> None:
    data = TRUNCATABLE[name]
    with pytest.raises(ImageDecodeError) as caught:
        open_raster(data[: int(len(data) * share)])
    assert caught.value.code == "image_undecodable"
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("missing", [1, 2, 40])
@pytest.mark.parametrize("name", ["jpeg", "progressive", "png", "webp", "bmp"])
def test_the_last_bytes_are_missed(name: str, missing: int) -> None:
    with pytest.raises(ImageDecodeError):
        open_raster(TRUNCATABLE[name][:-missing])


def test_bytes_after_the_end_do_no_harm() -> None:
    for data in (JPEG, PNG, WITH_THUMBNAIL, TRUNCATABLE["webp"], TRUNCATABLE["bmp"]):
        np.testing.assert_array_equal(read_all(data + b"trailer \xff\xd8\xff" * 9), read_all(data))


# --- OpenCV's log level, one for the whole process ---


@pytest.fixture
def log_level() -> Iterator[Any]:
    """OpenCV's functions ``setLogLevel`` and ``getLogLevel``, the level put back afterwards."""
    logging: Any = getattr(cv2.utils, "logging", cv2)  # OpenCV 5 moved them
    before = logging.getLogLevel()
    logging.setLogLevel(3)
    yield logging
    logging.setLogLevel(before)


def test_decoding_in_several_threads_leaves_the_log_level_as_it_was(
    log_level: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    first_in, second_in, first_out = threading.Event(), threading.Event(), threading.Event()
    original = cv2.imdecode
    levels = []

    def overlapping(data: Any, flags: int) -> Any:
        """The thread that came first leaves first."""
        if first_in.is_set():
            second_in.set()
            assert first_out.wait(timeout=10)
        else:
            first_in.set()
            assert second_in.wait(timeout=10)
        levels.append(log_level.getLogLevel())
        return original(data, flags)

    monkeypatch.setattr(cv2, "imdecode", overlapping)
    with ThreadPoolExecutor(2) as threads:
        first = threads.submit(open_raster, encoded(".png"))
        assert first_in.wait(timeout=10)
        second = threads.submit(open_raster, encoded(".png"))
        first.result(timeout=20)
        first_out.set()
        second.result(timeout=20)
    assert levels == [0, 0]
    assert log_level.getLogLevel() == 3


def test_a_log_level_that_was_set_meanwhile_stays(log_level: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    original = cv2.imdecode

    def loud(data: Any, flags: int) -> Any:
        log_level.setLogLevel(5)
        return original(data, flags)

    monkeypatch.setattr(cv2, "imdecode", loud)
    open_raster(encoded(".png"))
    assert log_level.getLogLevel() == 5
