from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from tests import bombs
from tests.skill.imagery.files import (
    EXIF_PREFIX,
    HEIGHT_PX,
    JPEG,
    PNG,
    RGB,
    TRUNCATABLE,
    WIDTH_PX,
    WITH_THUMBNAIL,
    after_start,
    bigtiff_header,
    bmp_header,
    encoded,
    exif,
    geotiff,
    header_of,
    jpeg_header,
    jpeg_with,
    pillow,
    png_header,
    read_all,
    segment,
    tiff_header,
    webp_header,
    without_rasterio,
)
from vehanchor.errors import ImageDecodeError, ImageFormatError
from vehanchor.imagery.sources.opening import open_raster


@pytest.mark.parametrize("value", [0, 9, 65535])
def test_a_meaningless_orientation_is_ignored(value: int) -> None:
    assert read_all(jpeg_with(value)).shape == RGB.shape


def test_an_end_mark_is_found_behind_the_scan() -> None:
    noise = np.random.default_rng(1).integers(0, 256, (300, 300, 3), dtype=np.uint8)
    data = encoded(".jpg", noise)
    assert header_of(data).complete
    assert not header_of(data[:-1]).complete


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\0",
        b"this is text",
        b"GIF89a" + bytes(50),
        b"\xff\xd8\xff",
        b"\xff\xd8\xff\xd9",
        b"\xff\xd8\xff\xe0\xff",
        b"\x89PNG\r\n\x1a\n",
        b"\x89PNG\r\n\x1a\n" + bytes(30),
        png_header(30, 30),
        jpeg_header(30, 30),
        bmp_header(30, 30),
        webp_header(30, 30),
        tiff_header(30, 30),
        b"BM",
        b"RIFF\0\0\0\0WEBP",
        b"II*\0",
        b"II*\0\xff\xff\xff\xff",
        b"II*\0\x08\0\0\0\xff\xff",
        b"II*\0\x08\0\0\0\0\0",
        bigtiff_header(30, 30),
    ],
    ids=lambda data: repr(data[:16]),
)
def test_a_file_that_is_not_an_image_is_undecodable(
    data: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(data)
    for image in (path, data, io.BytesIO(data)):
        with pytest.raises(ImageDecodeError) as caught:
            open_raster(image)
        assert caught.value.code == "image_undecodable"
    assert capfd.readouterr().err == ""


WIDTH = (256, 3, 1, 64)
HEIGHT = (257, 3, 1, 64)


def _raw(
    first: tuple[int, int],
    further: tuple[int, int],
    *,
    reduced: bool = False,
    chained: bool = False,
) -> bytes:
    """Make a TIFF with two pictures.

    Args:
        first: width and height in the first directory.
        further: width and height in a directory within the first one, or after it.
        reduced: whether the first picture is marked as reduced.
        chained: whether the other directory comes after the first one.
    """
    entries = [
        (254, 4, 1, int(reduced)),
        (256, 4, 1, first[0]),
        (257, 4, 1, first[1]),
        (258, 3, 1, 8),
        (262, 3, 1, 1),
    ]
    further_offset = 8 + 2 + 12 * (len(entries) + 1) + 4
    artist = (315, 4, 1, 0)
    sub_directory = (330, 13, 1, further_offset)
    entries.append(artist if chained else sub_directory)
    data = bombs.tiff_of_directory(entries)
    next_directory = struct.pack("<I", further_offset if chained else 0)
    further_directory = struct.pack("<H", 2)
    further_directory += struct.pack("<HHII", 256, 4, 1, further[0])
    further_directory += struct.pack("<HHII", 257, 4, 1, further[1])
    return data[:-4] + next_directory + further_directory + bytes(4)


@pytest.mark.parametrize(
    "data",
    [
        _raw((64, 64), (640, 480)),
        _raw((64, 64), (640, 480), reduced=True, chained=True),
        bombs.tiff_of_directory([WIDTH, HEIGHT, (262, 3, 1, 2), (50706, 1, 4, 1025)]),
        bombs.tiff_of_directory([WIDTH, HEIGHT, (262, 3, 1, 32803)]),
        b"II*\0\x10\0\0\0CR\2\0\0\0\0\0" + bombs.tiff_of_directory([WIDTH, HEIGHT])[8:],
    ],
)
def test_a_raw_file_is_refused_with_what_to_export(data: bytes) -> None:
    advice = "export the photograph as JPEG or TIFF in full size"
    with pytest.raises(ImageFormatError, match=advice):
        header_of(data)


@pytest.mark.parametrize(
    "data",
    [
        pytest.param(_raw((640, 480), (64, 64)), id="overview"),
        pytest.param(_raw((64, 64), (640, 480), chained=True), id="pages"),
        pytest.param(
            _raw((640, 480), (320, 240), reduced=True, chained=True), id="smaller reduced picture"
        ),
    ],
)
def test_files_of_several_pictures_are_not_all_raw(data: bytes) -> None:
    header = header_of(data)
    assert (header.width_px, header.height_px) in ((640, 480), (64, 64))


@pytest.mark.parametrize(
    "start", [b"\0\0\0\x18ftypcrx ", b"FUJIFILMCCD-RAW 0201", b"IIRO\x08\0\0\0", b"IIU\0\x18\0\0\0"]
)
def test_raw_files_of_other_forms_are_named(start: bytes) -> None:
    with pytest.raises(ImageDecodeError, match="raw file; export"):
        open_raster(start + bytes(40))


@pytest.mark.parametrize(
    ("start", "advice"),
    [
        (b"\xff\x0a", "JPEG XL"),
        (b"PK\3\4", "unpack"),
        (b"<!DOCTYPE html>", "page of the web"),
        (b"version https://git-lfs.github.com/spec/v1", "git lfs pull"),
    ],
)
def test_other_files_say_what_to_do(start: bytes, advice: str) -> None:
    with pytest.raises(ImageDecodeError, match=advice):
        open_raster(start + bytes(40))


_SIZE_OF_SAMPLES = JPEG.index(b"\xff\xc0") + 4
_INKS = pillow("JPEG", "CMYK")
_ADOBE = _INKS.index(b"\xff\xee")


@pytest.mark.parametrize(
    ("data", "advice"),
    [
        (JPEG[:_SIZE_OF_SAMPLES] + b"\x0c" + JPEG[_SIZE_OF_SAMPLES + 1 :], "12 bits"),
        (_INKS[:_ADOBE] + _INKS[_ADOBE + 16 :], "CMYK"),
        (JPEG[:2] + b"\xff\xf7\0\x0b\x08" + bytes(60), "JPEG-LS"),
    ],
    ids=["12 bits", "inks", "JPEG-LS"],
)
def test_a_jpeg_of_samples_that_are_not_decoded_says_what_to_do(data: bytes, advice: str) -> None:
    with pytest.raises(ImageFormatError, match=advice):
        header_of(data)


def test_the_inks_of_adobe_are_read() -> None:
    difference = read_all(_INKS).astype(int) - RGB
    assert np.abs(difference).mean() < 8


def test_a_tiff_of_plain_tiles_of_any_size_is_read(tmp_path: Path) -> None:
    noise = np.random.default_rng(2).integers(0, 256, (90, 130, 3), dtype=np.uint8)
    tiles: dict[str, Any] = {"tiled": True, "blockxsize": 48, "blockysize": 48}
    path = geotiff(tmp_path / "a.tif", noise, crs=None, transform=None, **tiles)
    np.testing.assert_array_equal(read_all(path), noise)


def test_a_directory_whose_values_exceed_the_file_is_refused() -> None:
    shared = [(tag, 1, 1000, 0) for tag in range(60_000, 60_010)]
    data = bombs.tiff_of_directory([WIDTH, HEIGHT, *shared], after=bytes(9000))
    with pytest.raises(ImageDecodeError, match="values of 10000 bytes, more than the file has"):
        header_of(data)
    assert header_of(data + bytes(1000)).width_px == 64


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
def test_images_of_one_band_become_three_bands(format_name: str, mode: str) -> None:
    data = pillow(format_name, mode)
    expected = np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))
    np.testing.assert_array_equal(read_all(data), expected)


def _white_is_zero(path: Path, grey: NDArray[Any]) -> Path:
    return geotiff(path, grey, photometric="MINISWHITE", crs=None, transform=None)


def test_a_tiff_of_8_bits_whose_white_is_zero_is_inverted(tmp_path: Path) -> None:
    grey = RGB[..., :1]
    path = _white_is_zero(tmp_path / "grey.tif", grey)
    np.testing.assert_array_equal(read_all(path)[..., 0], 255 - grey[..., 0])


def test_a_tiff_of_16_bits_whose_white_is_zero_is_refused(tmp_path: Path) -> None:
    path = _white_is_zero(tmp_path / "grey.tif", RGB[..., :1].astype(np.uint16))
    with pytest.raises(ImageFormatError, match="photometric interpretation 0"):
        open_raster(path)


def test_a_plain_tiff_of_floats_needs_no_rasterio(tmp_path: Path) -> None:
    unit = (RGB / 255).astype(np.float32)
    plain = geotiff(tmp_path / "a.tif", unit, crs=None, transform=None, photometric="RGB")
    with without_rasterio():
        np.testing.assert_array_equal(read_all(plain), RGB)


def test_a_png_of_16_bits_with_alpha_is_read_in_rgb_order() -> None:
    deep = RGB.astype(np.uint16) * 257
    opaque = np.full((HEIGHT_PX, WIDTH_PX), 65535, np.uint16)
    bgra = np.dstack([deep[..., ::-1], opaque])
    _, data = cv2.imencode(".png", bgra)
    np.testing.assert_array_equal(read_all(data.tobytes()), read_all(deep))


@pytest.mark.parametrize("share", [0.001, 0.02, 0.2, 0.5, 0.9, 0.99])
@pytest.mark.parametrize("name", TRUNCATABLE)
def test_a_truncated_file_is_not_measured(
    name: str, share: float, capfd: pytest.CaptureFixture[str]
) -> None:
    data = TRUNCATABLE[name]
    with pytest.raises(ImageDecodeError) as caught:
        open_raster(data[: int(len(data) * share)])
    assert caught.value.code == "image_undecodable"
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    "data", [JPEG, PNG, WITH_THUMBNAIL, TRUNCATABLE["webp"], TRUNCATABLE["bmp"]]
)
def test_bytes_after_the_end_do_no_harm(data: bytes) -> None:
    trailer = b"trailer \xff\xd8\xff" * 9
    np.testing.assert_array_equal(read_all(data + trailer), read_all(data))


@pytest.mark.parametrize(
    "block",
    [b"", b"II*\0", exif({"Orientation": 6})[:20], b"XX*\0" + b"\xff" * 20],
)
def test_damaged_exif_is_ignored(block: bytes) -> None:
    data = after_start(encoded(".jpg"), segment(EXIF_PREFIX + block))
    assert read_all(data).shape == RGB.shape


@pytest.mark.parametrize("missing", [1, 2, 40])
@pytest.mark.parametrize("name", ["jpeg", "progressive", "png", "webp", "bmp"])
def test_a_file_without_its_last_bytes_is_undecodable(name: str, missing: int) -> None:
    with pytest.raises(ImageDecodeError):
        open_raster(TRUNCATABLE[name][:-missing])
