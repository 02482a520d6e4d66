from __future__ import annotations

import io
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from tests import bombs
from tests.skill.imagery.files import (
    HEIGHT_PX,
    JPEG,
    PNG,
    RGB,
    TRUNCATABLE,
    WIDTH_PX,
    WITH_THUMBNAIL,
    bigtiff_header,
    bmp_header,
    encoded,
    exif,
    geotiff,
    jpeg_header,
    jpeg_with,
    pillow,
    png_header,
    read_all,
    tiff_header,
    webp_header,
    without_rasterio,
)
from vehanchor.errors import ImageDecodeError, ImageFormatError
from vehanchor.imagery.formats.header import read_header
from vehanchor.imagery.sources.opening import open_raster


@pytest.mark.parametrize("value", [0, 9, 65535])
def test_a_meaningless_orientation_is_ignored(value: int) -> None:
    assert read_all(jpeg_with(value)).shape == RGB.shape


def test_an_end_mark_is_found_behind_the_scan() -> None:
    data = encoded(".jpg", np.random.default_rng(1).integers(0, 256, (300, 300, 3), dtype=np.uint8))
    assert read_header(lambda at, n: data[at : at + n]).complete
    assert not read_header(lambda at, n: data[: len(data) - 1][at : at + n]).complete


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
def test_what_is_no_image_is_undecodable(
    data: bytes, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(data)
    for image in (path, data, io.BytesIO(data)):
        with pytest.raises(ImageDecodeError) as caught:
            open_raster(image)
        assert caught.value.code == "image_undecodable"
    assert capfd.readouterr().err == ""


def _raw(
    first: tuple[int, int],
    further: tuple[int, int],
    *,
    reduced: bool = False,
    chained: bool = False,
) -> bytes:
    """A TIFF with a picture in its first directory, and another in a directory within or after it."""
    entries = [
        (254, 4, 1, int(reduced)),
        (256, 4, 1, first[0]),
        (257, 4, 1, first[1]),
        (258, 3, 1, 8),
        (262, 3, 1, 1),
    ]
    at = 8 + 2 + 12 * (len(entries) + 1) + 4
    entries.append((315, 4, 1, 0) if chained else (330, 13, 1, at))
    data = bombs.tiff_of_directory(entries)
    inner = (
        struct.pack("<H", 2)
        + struct.pack("<HHIIHHII", 256, 4, 1, further[0], 257, 4, 1, further[1])
        + bytes(4)
    )
    return data[:-4] + struct.pack("<I", at if chained else 0) + inner


@pytest.mark.parametrize(
    "data",
    [
        _raw((64, 64), (640, 480)),
        _raw((64, 64), (640, 480), reduced=True, chained=True),
        bombs.tiff_of_directory(
            [(256, 3, 1, 64), (257, 3, 1, 64), (262, 3, 1, 2), (50706, 1, 4, 1025)]
        ),
        bombs.tiff_of_directory([(256, 3, 1, 64), (257, 3, 1, 64), (262, 3, 1, 32803)]),
        b"II*\0\x10\0\0\0CR\2\0\0\0\0\0"
        + bombs.tiff_of_directory([(256, 3, 1, 64), (257, 3, 1, 64)])[8:],
    ],
)
def test_a_raw_file_is_refused_with_what_to_export(data: bytes) -> None:
    with pytest.raises(
        ImageFormatError, match="export the photograph as JPEG or TIFF in full size"
    ):
        read_header(lambda offset, count: data[offset : offset + count])


@pytest.mark.parametrize(
    "data",
    [
        _raw((640, 480), (64, 64)),  # an overview
        _raw((64, 64), (640, 480), chained=True),  # pages
        _raw((640, 480), (320, 240), reduced=True, chained=True),
    ],
)
def test_overviews_and_pages_stay_as_they_are(data: bytes) -> None:
    header = read_header(lambda offset, count: data[offset : offset + count])
    assert (header.width_px, header.height_px) in ((640, 480), (64, 64))


@pytest.mark.parametrize(
    "start", [b"\0\0\0\x18ftypcrx ", b"FUJIFILMCCD-RAW 0201", b"IIRO\x08\0\0\0", b"IIU\0\x18\0\0\0"]
)
def test_raw_files_of_other_forms_are_named(start: bytes) -> None:
    with pytest.raises(ImageDecodeError, match="raw file; export"):
        open_raster(start + bytes(40))


def test_a_directory_whose_values_exceed_the_file_is_refused() -> None:
    shared = [(tag, 1, 1000, 0) for tag in range(60_000, 60_010)]
    data = bombs.tiff_of_directory([(256, 3, 1, 64), (257, 3, 1, 64), *shared], after=bytes(9000))
    with pytest.raises(ImageDecodeError, match="values of 10000 bytes, more than the file has"):
        read_header(lambda offset, count: data[offset : offset + count])
    longer = data + bytes(1000)
    assert read_header(lambda offset, count: longer[offset : offset + count]).width_px == 64


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
def test_a_truncated_file_is_not_measured(
    name: str, share: float, capfd: pytest.CaptureFixture[str]
) -> None:
    data = TRUNCATABLE[name]
    with pytest.raises(ImageDecodeError) as caught:
        open_raster(data[: int(len(data) * share)])
    assert caught.value.code == "image_undecodable"
    assert capfd.readouterr().err == ""


def test_bytes_after_the_end_do_no_harm() -> None:
    for data in (JPEG, PNG, WITH_THUMBNAIL, TRUNCATABLE["webp"], TRUNCATABLE["bmp"]):
        np.testing.assert_array_equal(read_all(data + b"trailer \xff\xd8\xff" * 9), read_all(data))


def test_damaged_exif_is_ignored() -> None:
    data = encoded(".jpg")
    for payload in (
        b"Exif\0\0",
        b"Exif\0\0II*\0",
        b"Exif\0\0" + exif({"Orientation": 6})[:20],
        b"Exif\0\0XX*\0" + b"\xff" * 20,
    ):
        segment = b"\xff\xe1" + struct.pack(">H", len(payload) + 2) + payload
        assert read_all(data[:2] + segment + data[2:]).shape == RGB.shape


@pytest.mark.parametrize("missing", [1, 2, 40])
@pytest.mark.parametrize("name", ["jpeg", "progressive", "png", "webp", "bmp"])
def test_the_last_bytes_are_missed(name: str, missing: int) -> None:
    with pytest.raises(ImageDecodeError):
        open_raster(TRUNCATABLE[name][:-missing])
