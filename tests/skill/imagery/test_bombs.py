from __future__ import annotations

import contextlib
import struct
import time
from collections.abc import Callable

import numpy as np
import pytest

from tests import bombs
from tests.skill.imagery.files import NOISE, encoded, read_all, tiff_header, webp
from vehanchor.errors import ImageDecodeError, ImageError, ImageTooLargeError
from vehanchor.imagery.formats.header import read_header
from vehanchor.imagery.formats.jpeg import MAX_SCANS, MAX_SEGMENTS
from vehanchor.imagery.raster import Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ImageLimits

_MIB = 1 << 20
_FLOOR_S = 0.02  # below it a clock tells nothing


def _opening_s(data: bytes) -> float:
    """Seconds of this process for opening an image, the best of three; refused or not."""
    taken = []
    for _ in range(3):
        started = time.process_time()
        with contextlib.suppress(ImageError):
            open_raster(data).close()
        taken.append(time.process_time() - started)
    return max(min(taken), _FLOOR_S)


@pytest.mark.parametrize("family", bombs.HEADER_BOMBS)
def test_a_header_is_read_by_few_and_small_reads(family: str) -> None:
    data = bombs.HEADER_BOMBS[family](_MIB)
    n_bytes = 0

    def read_at(offset: int, count: int) -> bytes:
        nonlocal n_bytes
        n_bytes += len(data[offset : offset + count])
        return data[offset : offset + count]

    with contextlib.suppress(ImageError):
        read_header(read_at)
    assert n_bytes < 2 * len(data)


def test_more_scans_than_pictures_have_are_refused_before_decoding() -> None:
    assert read_all(bombs.jpeg_of_scans(MAX_SCANS, 64)).shape == (64, 64, 3)
    for n_scans in (MAX_SCANS + 1, 2500):
        with pytest.raises(ImageTooLargeError, match=f"more than {MAX_SCANS} scans"):
            open_raster(bombs.jpeg_of_scans(n_scans, 64))


def test_scans_count_against_the_limit_on_pixels() -> None:
    data = bombs.jpeg_of_scans(50, 64)
    with pytest.raises(ImageTooLargeError, match="50 scans"):
        open_raster(data, limits=ImageLimits(max_pixels=64 * 64))
    open_raster(data, limits=ImageLimits(max_pixels=2 * 64 * 64)).close()


def test_more_segments_than_pictures_have_are_refused() -> None:
    data = encoded(".jpg")
    comment = b"\xff\xfe\x00\x02"
    assert read_all(data[:2] + comment * (MAX_SEGMENTS - 100) + data[2:]).size
    with pytest.raises(ImageTooLargeError, match="segments"):
        open_raster(data[:2] + comment * MAX_SEGMENTS + data[2:])


def test_scans_cannot_be_hidden_behind_stuffing() -> None:
    data = bombs.jpeg_of_scans(200, 64)
    hidden = data[:2] + b"\xff\x00" + struct.pack(">H", len(data) - 2) + data[2:] + encoded(".jpg")[2:]
    with pytest.raises(ImageDecodeError):
        open_raster(hidden)


def test_a_jpeg_with_two_frame_headers_is_refused() -> None:
    data = encoded(".jpg")
    frame = data.index(b"\xff\xc0")
    header = data[frame : frame + 2 + int.from_bytes(data[frame + 2 : frame + 4], "big")]
    with pytest.raises(ImageDecodeError, match="two frame headers"):
        open_raster(data[:frame] + header + data[frame:])


def test_an_end_mark_of_a_png_that_declares_a_gigabyte_is_no_end_mark() -> None:
    """Found by ``tests.fuzz``: 1,487 bytes took 1.2 GiB."""
    data = encoded(".png")
    with pytest.raises(ImageDecodeError, match="end mark"):
        open_raster(data[:-12] + struct.pack(">I", 1_275_068_416) + data[-8:])


def test_texts_of_a_png_are_not_unpacked() -> None:
    one, many = _opening_s(bombs.png_of_text(1)), _opening_s(bombs.png_of_text(20))
    assert many <= 3 * one


def test_a_png_is_the_same_picture_without_its_metadata(capfd: pytest.CaptureFixture[str]) -> None:
    data = encoded(".png", NOISE)
    with_text = bombs.png_of_text(1)
    text = with_text[33 : with_text.rindex(b"IDAT") - 4]
    np.testing.assert_array_equal(read_all(data[:33] + text + data[33:]), NOISE)
    read_all(bombs.HEADER_BOMBS["png empty chunks"](1000))
    assert capfd.readouterr().err == ""


@pytest.mark.promise("two-readers")
@pytest.mark.parametrize(
    ("data", "message"),
    [
        (bombs.tiff_with_two_sizes(), "tag 256 twice"),
        (bombs.tiff_of_directory([(256, 3, 1, 64), (257, 3, 1, 64), (33550, 3, 1, 1), (33550, 3, 1, 1)]), "twice"),
        (bombs.tiff_of_directory([(256, 8, 1, 64), (257, 3, 1, 64)]), "tag 256 has 1 values of type 8"),
        (bombs.tiff_of_directory([(256, 3, 2, 64 | 20_000 << 16), (257, 3, 1, 64)]), "several values"),
        (bombs.tiff_of_directory([(256, 3, 1, 64), (257, 3, 1, 64), (258, 8, 1, 64)]), "tag 258"),
        (bombs.tiff_of_directory([(256, 3, 1, 64), (257, 3, 1, 64), (258, 3, 2, 8), (277, 3, 1, 3)]), "2 values for 3"),
        (bombs.tiff_of_directory([(256, 3, 1, 64), (257, 3, 1, 64), (322, 3, 1, 64)]), "one side of its tiles"),
        (encoded(".png")[:33] + encoded(".png")[8:], "size twice"),
        (webp(b"VP8X", bytes(4) + b"\x3f\0\0\x3f\0\0") + b"VP8L\5\0\0\0\x2f" + b"\xff" * 4, "two different sizes"),
    ],
)
def test_what_two_readers_may_take_differently_is_refused(data: bytes, message: str) -> None:
    if data.startswith(b"RIFF"):
        data = data[:4] + struct.pack("<I", len(data) - 8) + data[8:]
    with pytest.raises(ImageDecodeError, match=message):
        open_raster(data)


@pytest.mark.promise("bombs")
@pytest.mark.parametrize(
    ("make", "decoded_bytes"),
    [
        (lambda: encoded(".png", np.zeros((100, 200, 3), np.uint16)), 12 * 20_000),
        (lambda: encoded(".png", np.zeros((100, 200), np.uint8)), 2 * 20_000),
        (lambda: encoded(".jpg", np.zeros((100, 200, 3), np.uint8)), 6 * 20_000),
        (lambda: bombs.jpeg_of_scans(12, 100), (3 + 6) * 10_000),
        (lambda: encoded(".webp", np.zeros((100, 200, 3), np.uint8)), 9 * 20_000),
        (lambda: encoded(".bmp", np.zeros((100, 200, 3), np.uint8)), 8 * 20_000),
    ],
)
def test_the_limit_is_what_decoding_takes_not_what_the_file_weighs(
    make: Callable[[], bytes], decoded_bytes: int
) -> None:
    data = make()
    open_raster(data, limits=ImageLimits(max_decoded_bytes=decoded_bytes, max_unpacked_bytes=1)).close()
    with pytest.raises(ImageTooLargeError, match=f"takes {decoded_bytes} bytes"):
        open_raster(data, limits=ImageLimits(max_decoded_bytes=decoded_bytes - 1, max_unpacked_bytes=1))


@pytest.mark.parametrize(("dtype", "bands"), [("float64", 4), ("uint16", 4), ("float64", 1), ("uint8", 3)])
def test_a_tiff_that_takes_too_much_is_read_by_windows_unless_its_strips_do(dtype: str, bands: int) -> None:
    side = 256
    pixel = max(4, bands * np.dtype(dtype).itemsize)
    tight = ImageLimits(max_decoded_bytes=side * side * pixel)
    with open_raster(bombs.zero_tiff(side, dtype, bands, rows=16), limits=tight) as raster:
        assert not raster.read(Window(0, 0, side, side)).any()
    with pytest.raises(ImageTooLargeError, match="stored in blocks"):
        open_raster(
            bombs.zero_tiff(side, dtype, bands), limits=ImageLimits(max_decoded_bytes=side * side * pixel // 4 * 3)
        )
    open_raster(bombs.zero_tiff(side, dtype, bands), limits=ImageLimits(max_decoded_bytes=3 * side * side * pixel))


def test_a_tile_larger_than_its_image_counts() -> None:
    header = tiff_header(64, 64)
    entries = [(256, 4, 1, 64), (257, 4, 1, 64), (258, 3, 1, 8), (262, 3, 1, 1), (322, 4, 1, 60_000)]
    data = bombs.tiff_of_directory([*entries, (323, 4, 1, 60_000), (324, 4, 1, 8), (325, 4, 1, 64)], after=header)
    with pytest.raises(ImageError):
        open_raster(data)


@pytest.mark.parametrize("side_px", [10_000])
def test_the_largest_ordinary_images_pass_the_limits_still(side_px: int) -> None:
    limits = ImageLimits()
    n_pixels = side_px * side_px
    assert n_pixels == limits.max_pixels
    for pixel_bytes in (6, 3 + 6, 8, 9):  # JPEG and RGB PNG, progressive JPEG, PNG and BMP with alpha, WebP
        assert n_pixels * pixel_bytes <= limits.max_decoded_bytes
