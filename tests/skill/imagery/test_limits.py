from __future__ import annotations

import contextlib
import io
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests import bombs
from tests.bombs import FAMILIES, FORMATS, MIB, cost, grows_too_fast
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
    webp,
    webp_header,
    webp_lossless_header,
    webp_lossy_header,
    without_rasterio,
)
from vehanchor.errors import (
    ImageDecodeError,
    ImageError,
    ImageFormatError,
    ImageTooLargeError,
    MissingExtraError,
)
from vehanchor.imagery.formats.header import read_header
from vehanchor.imagery.formats.image_header import ImageHeader
from vehanchor.imagery.formats.jpeg import MAX_SCANS, MAX_SEGMENTS
from vehanchor.imagery.limits import MIN_SIDE_PX, check_header
from vehanchor.imagery.raster import Window
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.options import ImageLimits, Reading

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
    "make",
    [
        png_header,
        jpeg_header,
        bmp_header,
        os2_bmp_header,
        webp_lossy_header,
        tiff_header,
        bigtiff_header,
    ],
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
    exact = ImageLimits(max_bytes=len(data))
    tight = ImageLimits(max_bytes=len(data) - 1)
    for make in (lambda: data, lambda: bytearray(data), lambda: path, lambda: io.BytesIO(data)):
        read_all(make(), limits=exact)
        with pytest.raises(ImageTooLargeError, match=str(len(data) - 1)):
            open_raster(make(), Reading(limits=tight))


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
        open_raster(stream, Reading(limits=ImageLimits(max_bytes=3_000_000)))
    assert stream.given == 3_000_001


def test_a_tiff_over_the_limits_for_whole_decoding_is_read_by_windows(tmp_path: Path) -> None:
    path = geotiff(
        tmp_path / "a.tif",
        NOISE,
        crs=None,
        transform=None,
        tiled=True,
        blockxsize=16,
        blockysize=16,
    )
    for limits in (ImageLimits(max_pixels=NOISE[..., 0].size - 1), ImageLimits(max_bytes=1000)):
        np.testing.assert_array_equal(read_all(path, limits=limits), NOISE)
        with without_rasterio(), pytest.raises(MissingExtraError):
            open_raster(path, Reading(limits=limits))
    with pytest.raises(ImageTooLargeError):
        open_raster(path, Reading(limits=ImageLimits(max_windowed_pixels=NOISE[..., 0].size - 1)))


@pytest.mark.parametrize("order", ["<", ">"])
def test_the_mask_of_a_tiff_is_held_to_the_same_limit_as_its_pixels(
    tmp_path: Path, order: str
) -> None:
    options: dict[str, Any] = {"ENDIANNESS": "BIG"} if order == ">" else {}
    data = bytearray(geotiff(tmp_path / "a.tif", NOISE, **options).read_bytes())
    (first,) = struct.unpack_from(order + "I", data, 4)
    (n_entries,) = struct.unpack_from(order + "H", data, first)
    struct.pack_into(order + "I", data, first + 2 + 12 * n_entries, len(data))
    mask = {
        254: 4,
        256: 1000,
        257: 1000,
        258: 1,
        259: 1,
        262: 4,
        273: 8,
        277: 1,
        278: 1000,
        279: 125_000,
    }
    data += struct.pack(order + "H", len(mask))
    for tag, value in mask.items():
        data += struct.pack(order + "HHII", tag, 4, 1, value)
    data += bytes(4)
    (tmp_path / "masked.tif").write_bytes(data)
    open_raster(
        tmp_path / "masked.tif", Reading(limits=ImageLimits(max_decoded_bytes=2_000_000))
    ).close()
    with pytest.raises(ImageTooLargeError, match="mask is stored in blocks of 1000000 pixels"):
        open_raster(
            tmp_path / "masked.tif", Reading(limits=ImageLimits(max_decoded_bytes=1_999_999))
        )


def test_a_tiff_of_more_directories_than_a_thousand_is_refused_and_a_circle_of_them_ends() -> None:
    directory = struct.pack("<HHHIIHHIIHHII", 3, 256, 4, 1, 64, 257, 4, 1, 64, 258, 3, 1, 8)
    size = len(directory) + 4
    chain = b"".join(directory + struct.pack("<I", 8 + size * (i + 1)) for i in range(1200))
    with pytest.raises(ImageDecodeError, match="more than 1000 directories"):
        read_header(lambda offset, count: (b"II*\0\x08\0\0\0" + chain)[offset : offset + count])
    circle = b"II*\0\x08\0\0\0" + directory + struct.pack("<I", 8)
    assert read_header(lambda offset, count: circle[offset : offset + count]).width_px == 64


def test_what_is_read_by_windows_may_have_as_many_pixels_as_its_own_limit_says() -> None:
    check_header(ImageHeader("TIFF", 90_000, 90_000), ImageLimits())
    with pytest.raises(ImageTooLargeError, match="the limit is 10000000000 pixels"):
        check_header(ImageHeader("TIFF", 110_000, 110_000), ImageLimits())


_MIB = 1 << 20


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


def test_more_segments_than_pictures_have_are_refused() -> None:
    data = encoded(".jpg")
    comment = b"\xff\xfe\x00\x02"
    assert read_all(data[:2] + comment * (MAX_SEGMENTS - 100) + data[2:]).size
    with pytest.raises(ImageTooLargeError, match="segments"):
        open_raster(data[:2] + comment * MAX_SEGMENTS + data[2:])


def test_scans_cannot_be_hidden_behind_stuffing() -> None:
    data = bombs.jpeg_of_scans(200, 64)
    hidden = (
        data[:2] + b"\xff\x00" + struct.pack(">H", len(data) - 2) + data[2:] + encoded(".jpg")[2:]
    )
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
        (
            bombs.tiff_of_directory(
                [(256, 3, 1, 64), (257, 3, 1, 64), (33550, 3, 1, 1), (33550, 3, 1, 1)]
            ),
            "twice",
        ),
        (
            bombs.tiff_of_directory([(256, 8, 1, 64), (257, 3, 1, 64)]),
            "tag 256 has 1 values of type 8",
        ),
        (
            bombs.tiff_of_directory([(256, 3, 2, 64 | 20_000 << 16), (257, 3, 1, 64)]),
            "several values",
        ),
        (bombs.tiff_of_directory([(256, 3, 1, 64), (257, 3, 1, 64), (258, 8, 1, 64)]), "tag 258"),
        (
            bombs.tiff_of_directory(
                [(256, 3, 1, 64), (257, 3, 1, 64), (258, 3, 2, 8), (277, 3, 1, 3)]
            ),
            "2 values for 3",
        ),
        (
            bombs.tiff_of_directory([(256, 3, 1, 64), (257, 3, 1, 64), (322, 3, 1, 64)]),
            "one side of its tiles",
        ),
        (encoded(".png")[:33] + encoded(".png")[8:], "size twice"),
        (
            webp(b"VP8X", bytes(4) + b"\x3f\0\0\x3f\0\0") + b"VP8L\5\0\0\0\x2f" + b"\xff" * 4,
            "two different sizes",
        ),
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
    open_raster(data, Reading(limits=ImageLimits(max_decoded_bytes=decoded_bytes))).close()
    with pytest.raises(ImageTooLargeError, match=f"takes {decoded_bytes} bytes"):
        open_raster(data, Reading(limits=ImageLimits(max_decoded_bytes=decoded_bytes - 1)))


@pytest.mark.parametrize(
    ("dtype", "bands"), [("float64", 4), ("uint16", 4), ("float64", 1), ("uint8", 3)]
)
def test_a_tiff_that_takes_too_much_is_read_by_windows_unless_its_strips_do(
    dtype: str, bands: int
) -> None:
    side = 256
    data = bombs.zero_tiff(256, dtype, bands)
    pixel = max(4, bands * np.dtype(dtype).itemsize)
    tight = ImageLimits(max_decoded_bytes=side * side * pixel)
    with open_raster(bombs.zero_tiff(side, dtype, bands, rows=16), Reading(limits=tight)) as raster:
        assert not raster.read(Window(0, 0, width_px=side, height_px=side)).any()
    with pytest.raises(ImageTooLargeError, match="stored in blocks"):
        open_raster(
            data, Reading(limits=ImageLimits(max_decoded_bytes=side * side * pixel // 4 * 3))
        )
    open_raster(data, Reading(limits=ImageLimits(max_decoded_bytes=3 * side * side * pixel)))


def test_a_tile_larger_than_its_image_counts() -> None:
    header = tiff_header(64, 64)
    entries = [
        (256, 4, 1, 64),
        (257, 4, 1, 64),
        (258, 3, 1, 8),
        (262, 3, 1, 1),
        (322, 4, 1, 60_000),
    ]
    data = bombs.tiff_of_directory(
        [*entries, (323, 4, 1, 60_000), (324, 4, 1, 8), (325, 4, 1, 64)], after=header
    )
    with pytest.raises(ImageError):
        open_raster(data)


_SIDE_PX = 2000
_OWN_MIB = 6.0  # of the decoders, whatever the size


@pytest.mark.slow
@pytest.mark.parametrize("name", FAMILIES)
def test_what_an_image_costs_grows_no_faster_than_its_size(name: str, tmp_path: Path) -> None:
    family = FAMILIES[name]
    small, large = (cost(family.make(size), tmp_path) for size in (family.size, 4 * family.size))
    assert not grows_too_fast(small, large), (small, large)
    # the limit on decoded bytes, and what the process had not loaded yet
    assert large.mebibytes < 1200


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_decoding_a_format_takes_what_its_header_predicts(name: str, tmp_path: Path) -> None:
    data = FORMATS[name](_SIDE_PX)
    predicted = (
        read_header(lambda offset, count: data[offset : offset + count]).decoding_bytes / MIB
    )
    measured = cost(data, tmp_path)
    assert measured.answer == "opened"
    assert measured.mebibytes <= predicted + _OWN_MIB, (measured, predicted)
    assert measured.mebibytes >= predicted / 2  # or ordinary images would be refused
