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
from PIL import Image

from tests import bombs
from tests.bombs import FAMILIES, FORMATS, MIB, cost, grows_too_fast
from tests.skill.imagery.files import (
    NOISE,
    PNG_HEAD_BYTES,
    after_head,
    after_start,
    bigtiff_header,
    bmp_header,
    encoded,
    geotiff,
    header_of,
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
from vehanchor.imagery.formats.ifd import in_memory
from vehanchor.imagery.formats.image_header import ImageHeader
from vehanchor.imagery.formats.jpeg import MAX_SCANS, MAX_SEGMENTS
from vehanchor.imagery.formats.png import without_ancillary_chunks
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
    size = f"{side_px} x {side_px - 1} px"
    tracemalloc.start()
    try:
        for image in (data, path):
            with pytest.raises(ImageTooLargeError, match=size) as caught:
                open_raster(image)
            assert caught.value.code == "image_too_large"
        _, peak_bytes = tracemalloc.get_traced_memory()
        assert peak_bytes < 4 << 20
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


ENCODED = encoded(".png", NOISE)
N_PIXELS = NOISE[..., 0].size


def _encoded_path(folder: Path) -> Path:
    path = folder / "a.png"
    path.write_bytes(ENCODED)
    return path


@pytest.mark.promise("bombs")
@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda folder: ENCODED, id="bytes"),
        pytest.param(lambda folder: bytearray(ENCODED), id="bytearray"),
        pytest.param(_encoded_path, id="path"),
        pytest.param(lambda folder: io.BytesIO(ENCODED), id="file object"),
    ],
)
def test_the_byte_limit_holds_for_every_kind_of_source(
    make: Callable[[Path], Any], tmp_path: Path
) -> None:
    exact = ImageLimits(max_bytes=len(ENCODED))
    tight = ImageLimits(max_bytes=len(ENCODED) - 1)
    read_all(make(tmp_path), limits=exact)
    with pytest.raises(ImageTooLargeError, match=str(len(ENCODED) - 1)):
        open_raster(make(tmp_path), Reading(limits=tight))


@pytest.mark.promise("bombs")
@pytest.mark.parametrize(
    "make",
    [
        pytest.param(lambda: ENCODED, id="bytes"),
        pytest.param(lambda: NOISE, id="array"),
        pytest.param(lambda: NOISE[..., 0], id="array of one band"),
        pytest.param(lambda: Image.fromarray(NOISE), id="Pillow image"),
    ],
)
def test_the_pixel_limit_holds_for_every_image_held_whole(make: Callable[[], Any]) -> None:
    exact = ImageLimits(max_pixels=N_PIXELS)
    tight = ImageLimits(max_pixels=N_PIXELS - 1)
    read_all(make(), limits=exact)
    message = f"has 130 x 90 px, the limit is {N_PIXELS - 1} pixels .*; convert it to a tiled TIFF"
    with pytest.raises(ImageTooLargeError, match=message):
        open_raster(make(), Reading(limits=tight))


def test_an_endless_file_object_is_left_at_the_limit() -> None:
    class Endless(io.RawIOBase):
        n_bytes_read = 0

        def readable(self) -> bool:
            return True

        def read(self, size: int = -1) -> bytes:
            assert size > 0
            self.n_bytes_read += size
            return b"\x89" * size

    stream: Any = Endless()
    with pytest.raises(ImageTooLargeError):
        open_raster(stream, Reading(limits=ImageLimits(max_bytes=3_000_000)))
    assert stream.n_bytes_read == 3_000_001


@pytest.fixture(scope="module")
def tiled_tiff(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A TIFF without georeference, in tiles of 16 px."""
    return geotiff(
        tmp_path_factory.mktemp("tiled") / "a.tif",
        NOISE,
        crs=None,
        transform=None,
        tiled=True,
        blockxsize=16,
        blockysize=16,
    )


OVER_THE_LIMITS = [ImageLimits(max_pixels=N_PIXELS - 1), ImageLimits(max_bytes=1000)]


@pytest.mark.parametrize("limits", OVER_THE_LIMITS)
def test_a_tiff_over_the_limits_for_whole_decoding_is_read_by_windows(
    limits: ImageLimits, tiled_tiff: Path
) -> None:
    np.testing.assert_array_equal(read_all(tiled_tiff, limits=limits), NOISE)


@pytest.mark.parametrize("limits", OVER_THE_LIMITS)
def test_reading_by_windows_needs_rasterio(limits: ImageLimits, tiled_tiff: Path) -> None:
    with without_rasterio(), pytest.raises(MissingExtraError):
        open_raster(tiled_tiff, Reading(limits=limits))


def test_an_image_read_by_windows_has_a_limit_of_its_own(tiled_tiff: Path) -> None:
    limits = ImageLimits(max_windowed_pixels=N_PIXELS - 1)
    with pytest.raises(ImageTooLargeError):
        open_raster(tiled_tiff, Reading(limits=limits))


def _with_mask(data: bytes, order: str) -> bytes:
    """Append a directory with a mask of one strip of 1000 x 1000 px."""
    masked = bytearray(data)
    (first,) = struct.unpack_from(order + "I", masked, 4)
    (n_entries,) = struct.unpack_from(order + "H", masked, first)
    next_directory = first + 2 + 12 * n_entries
    struct.pack_into(order + "I", masked, next_directory, len(masked))
    tags = {
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
    masked += struct.pack(order + "H", len(tags))
    for tag, value in tags.items():
        masked += struct.pack(order + "HHII", tag, 4, 1, value)
    return bytes(masked + bytes(4))


@pytest.mark.parametrize("order", ["<", ">"])
def test_the_mask_of_a_tiff_is_held_to_the_same_limit_as_its_pixels(
    tmp_path: Path, order: str
) -> None:
    options: dict[str, Any] = {"ENDIANNESS": "BIG"} if order == ">" else {}
    plain = geotiff(tmp_path / "a.tif", NOISE, **options)
    masked = tmp_path / "masked.tif"
    masked.write_bytes(_with_mask(plain.read_bytes(), order))
    exact = ImageLimits(max_decoded_bytes=2_000_000)
    tight = ImageLimits(max_decoded_bytes=1_999_999)
    open_raster(masked, Reading(limits=exact)).close()
    with pytest.raises(ImageTooLargeError, match="mask is stored in blocks of 1000000 pixels"):
        open_raster(masked, Reading(limits=tight))


TIFF_START = b"II*\0\x08\0\0\0"
DIRECTORY = struct.pack("<HHHIIHHIIHHII", 3, 256, 4, 1, 64, 257, 4, 1, 64, 258, 3, 1, 8)


def test_a_tiff_of_more_than_a_thousand_directories_is_refused() -> None:
    size = len(DIRECTORY) + 4
    chain = b"".join(DIRECTORY + struct.pack("<I", 8 + size * (i + 1)) for i in range(1200))
    with pytest.raises(ImageDecodeError, match="more than 1000 directories"):
        header_of(TIFF_START + chain)


def test_a_circle_of_directories_ends() -> None:
    circle = TIFF_START + DIRECTORY + struct.pack("<I", 8)
    assert header_of(circle).width_px == 64


def test_the_limit_of_windowed_images_is_above_that_of_others() -> None:
    check_header(ImageHeader("TIFF", 90_000, 90_000), ImageLimits())
    with pytest.raises(ImageTooLargeError, match="the limit is 10000000000 pixels"):
        check_header(ImageHeader("TIFF", 110_000, 110_000), ImageLimits())


@pytest.mark.parametrize("family", bombs.HEADER_BOMBS)
def test_a_header_is_read_at_most_twice(family: str) -> None:
    data = bombs.HEADER_BOMBS[family](MIB)
    read = in_memory(data)
    n_bytes = 0

    def read_at(offset: int, count: int) -> bytes:
        nonlocal n_bytes
        part = read(offset, count)
        n_bytes += len(part)
        return part

    with contextlib.suppress(ImageError):
        read_header(read_at)
    assert n_bytes < 2 * len(data)


def test_as_many_scans_as_pictures_have_are_read() -> None:
    assert read_all(bombs.jpeg_of_scans(MAX_SCANS, 64)).shape == (64, 64, 3)


@pytest.mark.parametrize("n_scans", [MAX_SCANS + 1, 2500])
def test_more_scans_than_pictures_have_are_refused(n_scans: int) -> None:
    with pytest.raises(ImageTooLargeError, match=f"more than {MAX_SCANS} scans"):
        open_raster(bombs.jpeg_of_scans(n_scans, 64))


JPEG = encoded(".jpg")
COMMENT = b"\xff\xfe\x00\x02"


def test_as_many_segments_as_pictures_have_are_read() -> None:
    assert read_all(after_start(JPEG, COMMENT * (MAX_SEGMENTS - 100))).size


def test_more_segments_than_pictures_have_are_refused() -> None:
    with pytest.raises(ImageTooLargeError, match="segments"):
        open_raster(after_start(JPEG, COMMENT * MAX_SEGMENTS))


def test_scans_cannot_be_hidden_behind_stuffing() -> None:
    bomb = bombs.jpeg_of_scans(200, 64)
    stuffing = b"\xff\x00" + struct.pack(">H", len(bomb) - 2)
    with pytest.raises(ImageDecodeError):
        open_raster(after_start(bomb, stuffing) + JPEG[2:])


def test_a_jpeg_with_two_frame_headers_is_refused() -> None:
    frame = JPEG.index(b"\xff\xc0")
    n_bytes = 2 + int.from_bytes(JPEG[frame + 2 : frame + 4], "big")
    header = JPEG[frame : frame + n_bytes]
    with pytest.raises(ImageDecodeError, match="two frame headers"):
        open_raster(JPEG[:frame] + header + JPEG[frame:])


def test_a_png_whose_end_mark_declares_a_gigabyte_is_truncated() -> None:
    """Found by ``tests.fuzz``: 1,487 bytes took 1.2 GiB."""
    png = encoded(".png")
    end_mark_start = len(png) - 12
    length = struct.pack(">I", 1_275_068_416)
    with pytest.raises(ImageDecodeError, match="truncated: its end is missing"):
        open_raster(png[:end_mark_start] + length + png[-8:])


def test_nothing_after_the_end_of_a_png_is_decoded() -> None:
    """Found by ``tests.fuzz.isolated``: OpenCV read on; 283 bytes took 2.1 GiB."""
    png = encoded(".png")
    end = struct.pack(">I4sI", 0, b"IEND", 0xAE426082)
    without_pixels = png[:PNG_HEAD_BYTES] + end
    assert without_ancillary_chunks(without_pixels + png[PNG_HEAD_BYTES:]) == without_pixels
    with pytest.raises(ImageDecodeError):
        open_raster(without_pixels + png[PNG_HEAD_BYTES:])


def _with_text(png: bytes) -> bytes:
    """Insert a compressed text that is a thousand times larger unpacked."""
    bomb = bombs.png_of_text(1)
    pixels_start = bomb.rindex(b"IDAT") - 4
    return after_head(png, bomb[PNG_HEAD_BYTES:pixels_start])


def test_a_png_is_the_same_picture_without_its_metadata() -> None:
    np.testing.assert_array_equal(read_all(_with_text(ENCODED)), NOISE)


def test_rejected_chunks_of_a_png_print_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    read_all(_with_text(ENCODED))
    read_all(bombs.HEADER_BOMBS["png empty chunks"](1000))
    assert capfd.readouterr().err == ""


WIDTH = (256, 3, 1, 64)
HEIGHT = (257, 3, 1, 64)
PIXEL_SCALE = (33550, 3, 1, 1)
PNG = encoded(".png")


@pytest.mark.promise("two-readers")
@pytest.mark.parametrize(
    ("data", "message"),
    [
        (bombs.tiff_with_two_sizes(), "tag 256 twice"),
        (bombs.tiff_of_directory([WIDTH, HEIGHT, PIXEL_SCALE, PIXEL_SCALE]), "twice"),
        (bombs.tiff_of_directory([(256, 8, 1, 64), HEIGHT]), "tag 256 has 1 values of type 8"),
        (bombs.tiff_of_directory([(256, 3, 2, 64 | 20_000 << 16), HEIGHT]), "several values"),
        (bombs.tiff_of_directory([WIDTH, HEIGHT, (258, 8, 1, 64)]), "tag 258"),
        (
            bombs.tiff_of_directory([WIDTH, HEIGHT, (258, 3, 2, 8), (277, 3, 1, 3)]),
            "2 values for 3",
        ),
        (bombs.tiff_of_directory([WIDTH, HEIGHT, (322, 3, 1, 64)]), "one side of its tiles"),
        (bombs.tiff_of_directory([WIDTH, HEIGHT, (277, 3, 1, 0)]), "without bands"),
        (PNG[:PNG_HEAD_BYTES] + PNG[8:], "size twice"),
        (
            webp(b"VP8X", bytes(4) + b"\x3f\0\0\x3f\0\0") + b"VP8L\5\0\0\0\x2f" + b"\xff" * 4,
            "two different sizes",
        ),
    ],
)
def test_a_file_that_two_readers_read_differently_is_refused(data: bytes, message: str) -> None:
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
def test_the_memory_for_decoding_is_limited_not_the_size_of_the_file(
    make: Callable[[], bytes], decoded_bytes: int
) -> None:
    data = make()
    exact = ImageLimits(max_decoded_bytes=decoded_bytes)
    tight = ImageLimits(max_decoded_bytes=decoded_bytes - 1)
    open_raster(data, Reading(limits=exact)).close()
    with pytest.raises(ImageTooLargeError, match=f"takes {decoded_bytes} bytes"):
        open_raster(data, Reading(limits=tight))


LAYOUTS = [("float64", 4), ("uint16", 4), ("float64", 1), ("uint8", 3)]
SIDE_PX = 256


def _block_bytes(dtype: str, bands: int) -> int:
    """Compute the memory of a block that is as large as the image."""
    return SIDE_PX * SIDE_PX * max(4, bands * np.dtype(dtype).itemsize)


@pytest.mark.parametrize(("dtype", "bands"), LAYOUTS)
def test_a_tiff_that_takes_too_much_memory_is_read_by_windows(dtype: str, bands: int) -> None:
    tight = ImageLimits(max_decoded_bytes=_block_bytes(dtype, bands))
    in_strips = bombs.zero_tiff(SIDE_PX, dtype, bands, rows=16)
    with open_raster(in_strips, Reading(limits=tight)) as raster:
        assert not raster.read(Window(0, 0, width_px=SIDE_PX, height_px=SIDE_PX)).any()


@pytest.mark.parametrize(("dtype", "bands"), LAYOUTS)
def test_a_strip_that_takes_too_much_memory_is_refused(dtype: str, bands: int) -> None:
    of_one_strip = bombs.zero_tiff(SIDE_PX, dtype, bands)
    tight = ImageLimits(max_decoded_bytes=_block_bytes(dtype, bands) // 4 * 3)
    enough = ImageLimits(max_decoded_bytes=3 * _block_bytes(dtype, bands))
    with pytest.raises(ImageTooLargeError, match="stored in blocks"):
        open_raster(of_one_strip, Reading(limits=tight))
    open_raster(of_one_strip, Reading(limits=enough))


def test_a_tile_larger_than_its_image_counts() -> None:
    header = tiff_header(64, 64)
    entries = [
        (256, 4, 1, 64),
        (257, 4, 1, 64),
        (258, 3, 1, 8),
        (262, 3, 1, 1),
        (322, 4, 1, 60_000),
        (323, 4, 1, 60_000),
        (324, 4, 1, 8),
        (325, 4, 1, 64),
    ]
    data = bombs.tiff_of_directory(entries, after=header)
    with pytest.raises(ImageError):
        open_raster(data)


FORMAT_SIDE_PX = 2000
OWN_MIB = 6.0
"""Memory of the decoders, whatever the size."""

MAX_MIB = 1200
"""The limit on decoded bytes, and modules that the process had not loaded yet."""


@pytest.mark.slow
@pytest.mark.parametrize("name", FAMILIES)
def test_the_cost_of_an_image_grows_no_faster_than_its_size(name: str, tmp_path: Path) -> None:
    family = FAMILIES[name]
    small = cost(family.make(family.size), tmp_path)
    large = cost(family.make(4 * family.size), tmp_path)
    assert not grows_too_fast(small, large), (small, large)
    assert large.mebibytes < MAX_MIB


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_decoding_a_format_takes_what_its_header_predicts(name: str, tmp_path: Path) -> None:
    data = FORMATS[name](FORMAT_SIDE_PX)
    predicted_mib = header_of(data).decoding_bytes / MIB
    measured = cost(data, tmp_path)
    assert measured.answer == "opened"
    assert measured.mebibytes <= predicted_mib + OWN_MIB, (measured, predicted_mib)
    assert measured.mebibytes >= predicted_mib / 2  # or ordinary images would be refused
