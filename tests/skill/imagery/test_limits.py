from __future__ import annotations

import io
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.skill.imagery.files import (
    NOISE,
    bigtiff_header,
    bmp_header,
    encoded,
    geotiff,
    jpeg_header,
    os2_bmp_header,
    png_header,
    read_all,
    tiff_header,
    tiff_header_of_a_mac,
    webp_header,
    webp_lossless_header,
    webp_lossy_header,
    without_rasterio,
)
from vehanchor.errors import (
    ImageDecodeError,
    ImageFormatError,
    ImageTooLargeError,
    InvalidParameterError,
    MissingExtraError,
)
from vehanchor.imagery.formats.header import ImageHeader, read_header
from vehanchor.imagery.limits import MIN_SIDE_PX, check_header
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ImageLimits

HUGE = [
    (png_header, 100_000),
    (jpeg_header, 65_500),
    (bmp_header, 100_000),
    (os2_bmp_header, 65_500),
    (webp_header, 100_000),
    (webp_lossy_header, 16_000),
    (webp_lossless_header, 16_000),
    (tiff_header, 200_000),
    (tiff_header_of_a_mac, 200_000),
    (bigtiff_header, 200_000),
]


@pytest.mark.promise("bombs")
@pytest.mark.parametrize(("make", "side_px"), HUGE)
def test_a_huge_declared_size_is_refused_before_decoding(
    make: Callable[[int, int], bytes], side_px: int, tmp_path: Path
) -> None:
    data = make(side_px, side_px - 1)
    path = tmp_path / "huge"
    path.write_bytes(data)
    tracemalloc.start()
    try:
        for image in (data, path):
            with pytest.raises(ImageTooLargeError, match=f"{side_px} x {side_px - 1} px") as caught:
                open_raster(image)
            assert caught.value.code == "image_too_large"
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    "make", [png_header, jpeg_header, bmp_header, os2_bmp_header, webp_lossy_header, tiff_header, bigtiff_header]
)
@pytest.mark.parametrize("size_px", [(0, 0), (0, 50), (50, 0), (1, 1), (MIN_SIDE_PX - 1, 500)])
def test_too_small_a_declared_size_cannot_be_measured(
    make: Callable[[int, int], bytes], size_px: tuple[int, int]
) -> None:
    with pytest.raises(ImageFormatError, match=f"{MIN_SIDE_PX} px a side") as caught:
        open_raster(make(*size_px))
    assert caught.value.code == "image_unsupported"


@pytest.mark.promise("bombs")
def test_the_byte_limit_holds_for_every_kind_of_source(tmp_path: Path) -> None:
    data = encoded(".png", NOISE)
    path = tmp_path / "a.png"
    path.write_bytes(data)
    exact, tight = ImageLimits(max_bytes=len(data)), ImageLimits(max_bytes=len(data) - 1)
    for make in (lambda: data, lambda: bytearray(data), lambda: path, lambda: io.BytesIO(data)):
        read_all(make(), limits=exact)
        with pytest.raises(ImageTooLargeError, match=str(len(data) - 1)):
            open_raster(make(), limits=tight)


def test_an_endless_file_object_is_left_at_the_limit() -> None:
    class Endless(io.RawIOBase):
        given = 0

        def readable(self) -> bool:
            return True

        def read(self, size: int = -1) -> bytes:
            assert size > 0
            self.given += size
            return b"\x89" * size

    stream: Any = Endless()
    with pytest.raises(ImageTooLargeError):
        open_raster(stream, limits=ImageLimits(max_bytes=3_000_000))
    assert stream.given == 3_000_001


def test_a_tiff_over_the_limits_for_whole_decoding_is_read_by_windows(tmp_path: Path) -> None:
    path = geotiff(tmp_path / "a.tif", NOISE, crs=None, transform=None, tiled=True, blockxsize=16, blockysize=16)
    for limits in (ImageLimits(max_pixels=NOISE[..., 0].size - 1), ImageLimits(max_bytes=1000)):
        np.testing.assert_array_equal(read_all(path, limits=limits), NOISE)
        with without_rasterio(), pytest.raises(MissingExtraError):
            open_raster(path, limits=limits)
    with pytest.raises(ImageTooLargeError):
        open_raster(path, limits=ImageLimits(max_windowed_pixels=NOISE[..., 0].size - 1))


def test_a_tiff_stored_in_one_huge_block_is_refused(tmp_path: Path) -> None:
    path = geotiff(tmp_path / "a.tif", NOISE, blockysize=NOISE.shape[0], compress="deflate")
    with pytest.raises(ImageTooLargeError, match="store it tiled"):
        open_raster(path, limits=ImageLimits(max_pixels=2000))


@pytest.mark.parametrize("order", ["<", ">"])
def test_the_mask_of_a_tiff_is_held_to_the_same_limit_as_its_pixels(tmp_path: Path, order: str) -> None:
    options: dict[str, Any] = {"ENDIANNESS": "BIG"} if order == ">" else {}
    data = bytearray(geotiff(tmp_path / "a.tif", NOISE, **options).read_bytes())
    (first,) = struct.unpack_from(order + "I", data, 4)
    (n_entries,) = struct.unpack_from(order + "H", data, first)
    struct.pack_into(order + "I", data, first + 2 + 12 * n_entries, len(data))
    mask = {254: 4, 256: 1000, 257: 1000, 258: 1, 259: 1, 262: 4, 273: 8, 277: 1, 278: 1000, 279: 125_000}
    data += struct.pack(order + "H", len(mask))
    for tag, value in mask.items():
        data += struct.pack(order + "HHII", tag, 4, 1, value)
    data += bytes(4)
    (tmp_path / "masked.tif").write_bytes(data)
    open_raster(tmp_path / "masked.tif", limits=ImageLimits(max_decoded_bytes=2_000_000)).close()
    with pytest.raises(ImageTooLargeError, match="mask is stored in blocks of 1000000 pixels"):
        open_raster(tmp_path / "masked.tif", limits=ImageLimits(max_decoded_bytes=1_999_999))


def test_a_tiff_of_more_directories_than_a_thousand_is_refused_and_a_circle_of_them_ends() -> None:
    directory = struct.pack("<HHHIIHHIIHHII", 3, 256, 4, 1, 64, 257, 4, 1, 64, 258, 3, 1, 8)
    size = len(directory) + 4
    chain = b"".join(directory + struct.pack("<I", 8 + size * (i + 1)) for i in range(1200))
    with pytest.raises(ImageDecodeError, match="more than 1000 directories"):
        read_header(lambda offset, count: (b"II*\0\x08\0\0\0" + chain)[offset : offset + count])
    circle = b"II*\0\x08\0\0\0" + directory + struct.pack("<I", 8)
    assert read_header(lambda offset, count: circle[offset : offset + count]).width_px == 64


@pytest.mark.parametrize("name", ["max_bytes", "max_pixels", "max_windowed_pixels"])
def test_limits_are_positive(name: str) -> None:
    with pytest.raises(InvalidParameterError, match=name):
        ImageLimits(**{name: 0})


def test_what_is_read_by_windows_may_have_as_many_pixels_as_its_own_limit_says() -> None:
    """Above 2.5 gigapixels a TIFF was said to have too many scans: one."""
    check_header(ImageHeader("TIFF", 90_000, 90_000, windowed=True), ImageLimits())
    with pytest.raises(ImageTooLargeError, match="the limit is 10000000000 pixels"):
        check_header(ImageHeader("TIFF", 110_000, 110_000, windowed=True), ImageLimits())
