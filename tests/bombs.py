"""Images that cost more than they weigh, each in any size, as an attacker would send them."""

from __future__ import annotations

import io
import json
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from tests.skill.imagery.heic_files import Item, grid, heic, identity, nested_overlays, overlay
from vehanchor.imagery.formats.header import IMAGE_FORMATS

_FRAME = b"\xff\xc0" + struct.pack(">HBHHB", 17, 8, 64, 64, 3) + bytes(9)
"""Frame header of a JPEG of 64 x 64 px."""

_JPEG_START = b"\xff\xd8"
_JPEG_END = b"\xff\xd9"
_SCAN = b"\xff\xda\x00\x02"
"""Header of an empty scan of a JPEG."""


def _jpeg(filling: bytes) -> Callable[[int], bytes]:
    """Make a JPEG of about so many bytes that repeats ``filling``."""

    def make(n_bytes: int) -> bytes:
        n_fillings = n_bytes // len(filling)
        return _JPEG_START + _FRAME + filling * n_fillings + _JPEG_END

    return make


def _jpeg_of_stuffing(n_bytes: int) -> bytes:
    """Make a JPEG of one scan with stuffing only."""
    stuffing = b"\xff\0" * (n_bytes // 2)
    return _JPEG_START + _FRAME + _SCAN + stuffing + _JPEG_END


def _webp_chunks(n_bytes: int) -> bytes:
    """Make a WebP of unknown, empty chunks."""
    sides = 63 | 63 << 14
    image = b"VP8L" + struct.pack("<I", 5) + b"\x2f" + struct.pack("<I", sides) + b"\0"
    body = b"WEBP" + b"junk\0\0\0\0" * (n_bytes // 8) + image
    return b"RIFF" + struct.pack("<I", len(body)) + body


def _chunk(kind: bytes, body: bytes) -> bytes:
    """Make a chunk of a PNG."""
    checksum = zlib.crc32(kind + body)
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", checksum)


def _png(between: bytes, side_px: int = 64) -> bytes:
    """Make a PNG of zeros with these chunks between its head and its pixels."""
    rows = (b"\0" + bytes(3 * side_px)) * side_px
    head = _chunk(b"IHDR", struct.pack(">IIBBBBB", side_px, side_px, 8, 2, 0, 0, 0))
    pixels = _chunk(b"IDAT", zlib.compress(rows))
    return b"\x89PNG\r\n\x1a\n" + head + between + pixels + _chunk(b"IEND", b"")


def _png_chunks(n_bytes: int) -> bytes:
    """Make a PNG of empty texts."""
    return _png(_chunk(b"tEXt", b"") * (n_bytes // 12))


HEADER_BOMBS: dict[str, Callable[[int], bytes]] = {
    "jpeg scan headers": _jpeg(_SCAN),
    "jpeg scan headers and stuffing": _jpeg(_SCAN + b"\xff\x00"),
    "jpeg fill bytes": _jpeg(b"\xff"),
    "jpeg TEM markers": _jpeg(b"\xff\x01"),
    "jpeg empty comments": _jpeg(b"\xff\xfe\x00\x02"),
    "jpeg restart markers": _jpeg(_SCAN + b"\xff\xd0" * 30),
    "jpeg stuffing": _jpeg_of_stuffing,
    "webp empty chunks": _webp_chunks,
    "png empty chunks": _png_chunks,
}
"""Images of about so many bytes, most of them for the reader of the header, by family."""


def jpeg_of_scans(n_scans: int, side_px: int = 512) -> bytes:
    """Make a progressive JPEG that refines the same coefficients again and again."""
    rng = np.random.default_rng(1)
    noise = rng.integers(0, 256, (side_px, side_px, 3), dtype=np.uint8)
    image = cv2.GaussianBlur(noise, (0, 0), 8).astype(np.uint8)
    options = [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_QUALITY, 30]
    done, encoded = cv2.imencode(".jpg", image, options)
    assert done
    data = encoded.tobytes()
    scan_marker = _SCAN[:2]
    last_scan_start = data.rindex(scan_marker)
    n_before = data.count(scan_marker) - 1
    last_scan = data[last_scan_start : -len(_JPEG_END)]
    return data[:last_scan_start] + last_scan * (n_scans - n_before) + _JPEG_END


def png_of_text(n_chunks: int, mebibytes: float = 7.5) -> bytes:
    """Make a PNG with compressed texts that are a thousand times larger unpacked."""
    unpacked = bytes(int(mebibytes * (1 << 20)))
    text = b"Comment\0\0" + zlib.compress(unpacked, 9)
    return _png(_chunk(b"zTXt", text) * n_chunks)


_SHORT = 3
_LONG = 4
_SIGNED_SHORT = 8


def tiff_of_directory(
    entries: list[tuple[int, int, int, int]], order: str = "<", after: bytes = b""
) -> bytes:
    """Make a TIFF of one directory.

    Args:
        entries: tag, type, number of values, and value or offset of each entry.
        order: byte order.
        after: bytes after the directory.
    """
    mark = b"II" if order == "<" else b"MM"
    data = mark + struct.pack(order + "HIH", 42, 8, len(entries))
    for tag, kind, n_values, value in entries:
        is_short = kind in (_SHORT, _SIGNED_SHORT) and n_values == 1
        entry_format = "HHIHxx" if is_short else "HHII"
        data += struct.pack(order + entry_format, tag, kind, n_values, value)
    return data + bytes(4) + after


def tiff_with_two_sizes(small_px: int = 64, large_px: int = 20_000) -> bytes:
    """Make a TIFF that declares two sizes: 64 px for one reader, 20,000 px for another."""
    entries = [
        (256, _LONG, 1, large_px),
        (256, _LONG, 1, small_px),
        (257, _LONG, 1, large_px),
        (257, _LONG, 1, small_px),
        (258, _SHORT, 1, 8),
        (259, _SHORT, 1, 1),
        (262, _SHORT, 1, 1),
        (273, _LONG, 1, 8),
        (277, _SHORT, 1, 1),
        (278, _LONG, 1, large_px),
        (279, _LONG, 1, small_px * small_px),
    ]
    return tiff_of_directory(entries, after=bytes(small_px * small_px))


def zero_tiff(
    side_px: int, dtype: str = "float64", bands: int = 4, rows: int | None = None
) -> bytes:
    """Make a small file of a large image: zeros in deflated strips of so many rows (None: one)."""
    rows = rows or side_px
    pixel_bytes = bands * np.dtype(dtype).itemsize
    strip = zlib.compress(bytes(rows * side_px * pixel_bytes), 9)
    return strip_tiff(side_px, dtype, bands=bands, rows=rows, strip=strip)


def strip_tiff(side_px: int, dtype: str, *, bands: int, rows: int, strip: bytes) -> bytes:
    """Make a deflated TIFF, all whose strips are the same bytes."""
    depth = np.dtype(dtype)
    bits = 8 * depth.itemsize
    sample_format = 3 if depth.kind == "f" else 1
    n_strips = -(-side_px // rows)
    has_extra_band = bands in (2, 4)

    # Values that do not fit into their entries follow the directory, in this order.
    n_entries = 13 if has_extra_band else 12
    directory_end = 8 + 2 + n_entries * 12 + 4
    bits_of_bands = struct.pack(f"<{bands}H", *[bits] * bands)
    formats_of_bands = struct.pack(f"<{bands}H", *[sample_format] * bands)
    bits_start = directory_end
    formats_start = bits_start + len(bits_of_bands)
    offsets_start = formats_start + len(formats_of_bands)
    counts_start = offsets_start + 4 * n_strips
    strip_start = counts_start + 4 * n_strips

    has_many_bands = bands > 2
    has_many_strips = n_strips > 1
    entries = [
        (256, _LONG, 1, side_px),
        (257, _LONG, 1, side_px),
        (258, _SHORT, bands, bits_start if has_many_bands else bits),
        (259, _SHORT, 1, 8),
        (262, _SHORT, 1, 2 if bands >= 3 else 1),
        (273, _LONG, n_strips, offsets_start if has_many_strips else strip_start),
        (277, _SHORT, 1, bands),
        (278, _LONG, 1, rows),
        (279, _LONG, n_strips, counts_start if has_many_strips else len(strip)),
        (284, _SHORT, 1, 1),
        (339, _SHORT, bands, formats_start if has_many_bands else sample_format),
        (317, _SHORT, 1, 1),
    ]
    if has_extra_band:
        entries.append((338, _SHORT, 1, 0))
    entries.sort()
    offsets = struct.pack(f"<{n_strips}I", *[strip_start] * n_strips)
    counts = struct.pack(f"<{n_strips}I", *[len(strip)] * n_strips)
    after = bits_of_bands + formats_of_bands + offsets + counts + strip
    return tiff_of_directory(entries, after=after)


def one_strip_tiff(pixels: NDArray[np.uint8]) -> bytes:
    """Make an honest TIFF of one strip."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "TIFF", tiffinfo={278: len(pixels)})
    return buffer.getvalue()


GENEROUS = 3.0
"""Times that a cost may be above proportion, or above the floors, before the check fails."""

FLOOR_S = 0.1
FLOOR_MIB = 64.0
"""Costs below the floors are not compared: a process has as much of its own."""

MIB = 1 << 20
_WORK = """
import json, sys, time
from vehanchor.errors import ImageError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.imagery.raster import Window

def peak_kib():
    # Not getrusage: a child inherits its parent's ru_maxrss.
    for line in open("/proc/self/status"):
        if line.startswith("VmHWM"):
            return int(line.split()[1])

data = open(sys.argv[1], "rb").read()
before = peak_kib()
started = time.process_time()
try:
    with open_raster(data) as raster:
        raster.read(Window(0, 0, 16, 16))
    answer = "opened"
except ImageError as error:
    answer = error.code
seconds = time.process_time() - started
mebibytes = (peak_kib() - before) / 1024
print(json.dumps([seconds, mebibytes, answer]))
"""


class Family(NamedTuple):
    """A way to be expensive.

    Attributes:
        make: makes an image of a size.
        size: bytes, scans, chunks or pixels of the smaller of two images; the other is four times
            as large.
        unit: unit of the size.
    """

    make: Callable[[int], bytes]
    size: int
    unit: str


class Cost(NamedTuple):
    """Cost of opening an image.

    Attributes:
        seconds: time of the processor.
        mebibytes: peak of memory, above the memory of the process before.
        answer: ``opened``, or the code of the error.
    """

    seconds: float
    mebibytes: float
    answer: str


def _zeros(dtype: str, bands: int, rows: int | None) -> Callable[[int], bytes]:
    """Make a square TIFF of zeros with so many pixels."""
    return lambda n_pixels: zero_tiff(int(n_pixels**0.5), dtype, bands=bands, rows=rows)


def _progressive_jpeg(n_scans: int) -> bytes:
    """Make a progressive JPEG of 1 megapixel."""
    return jpeg_of_scans(n_scans, 1024)


def _tiff_of_two_sizes(side_px: int) -> bytes:
    return tiff_with_two_sizes(large_px=side_px)


def _tiff_of_shared_tags(n_bytes: int) -> bytes:
    """Make a TIFF of 4,000 unknown tags, all with the same bytes."""
    entries = [(256, _LONG, 1, 64), (257, _LONG, 1, 64), (258, _SHORT, 1, 8), (262, _SHORT, 1, 1)]
    shared = [(tag, 1, n_bytes - 60_000, 50_000) for tag in range(40_000, 44_000)]
    return tiff_of_directory([*entries, *shared], after=bytes(n_bytes - 12 * 4004 - 14))


def _tiff_of_rows(n_rows: int) -> bytes:
    """Make a TIFF of 64 columns, each row a strip of the same bytes."""
    return _tiff_of_blocks(64, n_rows, size_of_block={278: 1}, n_blocks=n_rows, block_px=64)


def _tiff_of_small_tiles(side_px: int) -> bytes:
    """Make a square TIFF of tiles of 16 px, all the same bytes."""
    n_blocks = (-(-side_px // 16)) ** 2
    sides = {322: 16, 323: 16}
    return _tiff_of_blocks(side_px, side_px, size_of_block=sides, n_blocks=n_blocks, block_px=256)


def _tiff_of_blocks(
    width: int, height: int, *, size_of_block: dict[int, int], n_blocks: int, block_px: int
) -> bytes:
    """Make a deflated grey TIFF, all whose strips or tiles are the same bytes."""
    block = zlib.compress(bytes(block_px), 9)
    n_entries = 9 + len(size_of_block)
    offsets_start = 8 + 2 + n_entries * 12 + 4
    counts_start = offsets_start + 4 * n_blocks
    block_start = counts_start + 4 * n_blocks
    is_tiled = 322 in size_of_block
    entries = [
        (256, _LONG, 1, width),
        (257, _LONG, 1, height),
        (258, _SHORT, 1, 8),
        (259, _SHORT, 1, 8),
        (262, _SHORT, 1, 1),
        (277, _SHORT, 1, 1),
        (284, _SHORT, 1, 1),
        (324 if is_tiled else 273, _LONG, n_blocks, offsets_start),
        (325 if is_tiled else 279, _LONG, n_blocks, counts_start),
        *[(tag, _LONG, 1, value) for tag, value in size_of_block.items()],
    ]
    entries.sort()
    offsets = struct.pack(f"<{n_blocks}I", *[block_start] * n_blocks)
    counts = struct.pack(f"<{n_blocks}I", *[len(block)] * n_blocks)
    return tiff_of_directory(entries, after=offsets + counts + block)


def _tiff_of_one_long_tag(n_bytes: int) -> bytes:
    """Make a TIFF with one unknown tag of so many bytes."""
    entries = [
        (256, _LONG, 1, 64),
        (257, _LONG, 1, 64),
        (258, _SHORT, 1, 8),
        (259, _SHORT, 1, 1),
        (262, _SHORT, 1, 1),
        (273, _LONG, 1, 8),
        (277, _SHORT, 1, 1),
        (278, _LONG, 1, 64),
        (279, _LONG, 1, 64 * 64),
        (50_000, 1, n_bytes, 500),
    ]
    return tiff_of_directory(entries, after=bytes(n_bytes + 5000))


def _png_of_empty_pixels(n_chunks: int) -> bytes:
    """Make a PNG with empty chunks before its pixels."""
    return _png(_chunk(b"IDAT", b"") * n_chunks)


def _webp_animation(n_frames: int) -> bytes:
    """Make a WebP of so many frames of 64 x 64 px."""
    frames = [Image.new("RGB", (64, 64), (i % 256, i // 256, 0)) for i in range(1, n_frames + 1)]
    buffer = io.BytesIO()
    frames[0].save(buffer, "WEBP", save_all=True, append_images=frames[1:], lossless=True)
    return buffer.getvalue()


def _jpeg_of_restarts(n_pixels: int) -> bytes:
    """Make a JPEG with a restart marker after each block."""
    side_px = int(n_pixels**0.5)
    buffer = io.BytesIO()
    Image.new("RGB", (side_px, side_px)).save(buffer, "JPEG", restart_marker_blocks=1)
    return buffer.getvalue()


def _bmp_of_runs(run: bytes) -> Callable[[int], bytes]:
    """Make a BMP of 1 megapixel in 256 colours whose runs are these."""

    def make(n_runs: int) -> bytes:
        pixels = run * n_runs + b"\0\1"
        start = 14 + 40 + 1024
        fields = (40, 1000, 1000, 1, 8, 1, len(pixels), 0, 0, 256, 0)
        head = b"BM" + struct.pack("<IHHI", start + len(pixels), 0, 0, start)
        return head + struct.pack("<IiiHHIIiiII", *fields) + bytes(1024) + pixels

    return make


def _heic_grid(n_tiles: int) -> bytes:
    """Make a HEIC of so many tiles, in four rows."""
    n_columns = n_tiles // 4
    tiles = list(range(2, 2 + 4 * n_columns))
    return heic([grid(tiles, n_columns), *[Item()] * len(tiles)])


def _heic_overlay(n_pictures: int) -> bytes:
    """Make a HEIC of pictures one upon the other."""
    pictures = list(range(2, 2 + n_pictures))
    return heic([overlay(pictures), *[Item()] * n_pictures])


def _heic_chain(n_pictures: int) -> bytes:
    """Make a HEIC of pictures each of which is the next one."""
    chain = [identity(number + 1) for number in range(1, n_pictures)]
    return heic([*chain, Item()])


def _heic_of_nested_overlays(n_pictures: int) -> bytes:
    """Make a HEIC of overlays in four levels."""
    return nested_overlays(n_levels=4, n_pictures=n_pictures)


FAMILIES: dict[str, Family] = {
    **{name: Family(make, MIB, "bytes") for name, make in HEADER_BOMBS.items()},
    "progressive JPEG, 1 megapixel": Family(_progressive_jpeg, 25, "scans"),
    "progressive JPEG, beyond the limit": Family(_progressive_jpeg, 625, "scans"),
    "PNG with zipped texts": Family(png_of_text, 50, "texts"),
    "TIFF float64 RGBA, strips": Family(_zeros("float64", 4, 16), 16_000_000, "pixels"),
    "TIFF float64 grey, one strip": Family(_zeros("float64", 1, None), 16_000_000, "pixels"),
    "TIFF 16-bit RGBA, one strip": Family(_zeros("uint16", 4, None), 16_000_000, "pixels"),
    "TIFF 8-bit RGB, one strip": Family(_zeros("uint8", 3, None), 16_000_000, "pixels"),
    "TIFF of two sizes": Family(_tiff_of_two_sizes, 5_000, "pixels a side"),
    "TIFF of shared tags": Family(_tiff_of_shared_tags, 1 << 18, "bytes"),
    "TIFF, each row a strip": Family(_tiff_of_rows, 250_000, "rows"),
    "TIFF of tiles of 16 px": Family(_tiff_of_small_tiles, 4000, "pixels a side"),
    "TIFF of tiles of 16 px, large": Family(_tiff_of_small_tiles, 12_000, "pixels a side"),
    "TIFF of one long tag": Family(_tiff_of_one_long_tag, 4 * MIB, "bytes"),
    "PNG of empty pixels": Family(_png_of_empty_pixels, 24_000, "chunks"),
    "WebP animation": Family(_webp_animation, 500, "frames"),
    "JPEG of restarts": Family(_jpeg_of_restarts, 4_000_000, "pixels"),
    "BMP of runs of one": Family(_bmp_of_runs(b"\1\0"), 250_000, "runs"),
    "BMP of empty steps": Family(_bmp_of_runs(b"\0\2\0\0"), MIB, "runs"),
    "HEIC of tiles": Family(_heic_grid, 220, "tiles"),
    "HEIC of overlays": Family(_heic_overlay, 220, "pictures"),
    "HEIC of identities": Family(_heic_chain, 220, "pictures"),
    "HEIC of nested overlays": Family(_heic_of_nested_overlays, 6, "pictures a level"),
}


def _noise(side_px: int, bands: int, dtype: str = "uint8") -> NDArray[Any]:
    """Make smooth noise, which every format compresses somewhat; alpha has many values."""
    coarse_shape = (side_px // 8, side_px // 8, bands)
    rng = np.random.default_rng(1)
    coarse = rng.integers(1, 255, coarse_shape, dtype=np.uint8)
    fine = cv2.resize(coarse, (side_px, side_px), interpolation=cv2.INTER_LINEAR)
    factor = 1 if dtype == "uint8" else 4
    return fine.reshape(side_px, side_px, bands).astype(dtype) * factor


def _encoded(
    suffix: str, bands: int, dtype: str = "uint8", *parameters: int
) -> Callable[[int], bytes]:
    """Make a square image of a format."""

    def make(side_px: int) -> bytes:
        _, data = cv2.imencode(suffix, _noise(side_px, bands, dtype), parameters)
        return data.tobytes()

    return make


_FAST_AVIF = (cv2.IMWRITE_AVIF_SPEED, 10)
_DEEP_AVIF = (*_FAST_AVIF, cv2.IMWRITE_AVIF_DEPTH, 10)
_PLAIN_FORMATS = {
    name: _encoded(image_format.suffixes[0], 3)
    for name, image_format in IMAGE_FORMATS.items()
    if image_format.opencv
}
FORMATS: dict[str, Callable[[int], bytes]] = {
    **_PLAIN_FORMATS,
    "JPEG, grey": _encoded(".jpg", 1),
    "JPEG, progressive": _encoded(".jpg", 3, "uint8", cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "PNG with alpha": _encoded(".png", 4),
    "PNG, grey": _encoded(".png", 1),
    "PNG, 16 bits": _encoded(".png", 3, "uint16"),
    "WebP, lossless": _encoded(".webp", 3, "uint8", cv2.IMWRITE_WEBP_QUALITY, 101),
    "WebP with alpha": _encoded(".webp", 4, "uint8", cv2.IMWRITE_WEBP_QUALITY, 60),
    "AVIF": _encoded(".avif", 3, "uint8", *_FAST_AVIF),
    "AVIF, lossless": _encoded(".avif", 3, "uint8", *_FAST_AVIF, cv2.IMWRITE_AVIF_QUALITY, 100),
    "AVIF with alpha": _encoded(".avif", 4, "uint8", *_FAST_AVIF),
    "AVIF, 10 bits": _encoded(".avif", 3, "uint16", *_DEEP_AVIF),
    "AVIF with alpha, 10 bits": _encoded(".avif", 4, "uint16", *_DEEP_AVIF),
    "BMP with alpha": _encoded(".bmp", 4),
    "TIFF in strips, 16 bits": _encoded(".tif", 3, "uint16"),
    "TIFF in strips, floats": _encoded(".tif", 3, "float32"),
    "TIFF of one strip": lambda side_px: one_strip_tiff(_noise(side_px, 3)),
    "TIFF of one strip with alpha": lambda side_px: one_strip_tiff(_noise(side_px, 4)),
    "TIFF of one strip, grey": lambda side_px: one_strip_tiff(_noise(side_px, 1)[..., 0]),
    "TIFF of one strip, 16 bits": lambda side_px: zero_tiff(side_px, "uint16", 3),
}
"""Honest images of every format that is decoded whole, of so many pixels a side."""


def cost(data: bytes, folder: Path) -> Cost:
    """Measure the cost of opening an image, in a new process."""
    path = folder / "bomb"
    path.write_bytes(data)
    done = subprocess.run(
        [sys.executable, "-c", _WORK, str(path)],
        capture_output=True,
        text=True,
        check=True,
        timeout=120,
    )
    return Cost(*json.loads(done.stdout))


def grows_too_fast(small: Cost, large: Cost, factor: int = 4) -> bool:
    """Test whether the larger image costs more than in proportion, generously."""
    allowed_s = GENEROUS * factor * max(small.seconds, FLOOR_S / factor)
    allowed_mib = GENEROUS * factor * max(small.mebibytes, FLOOR_MIB / factor)
    return large.seconds > allowed_s or large.mebibytes > allowed_mib
