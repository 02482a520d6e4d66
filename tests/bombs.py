"""Images that cost more than they weigh, each in any size: what an attacker sends."""

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

_SOF = b"\xff\xc0" + struct.pack(">HBHHB", 17, 8, 64, 64, 3) + bytes(9)


def _jpeg(filling: bytes) -> Callable[[int], bytes]:
    """``FF D8``, then ``filling`` over and over, up to so many bytes."""

    def make(n_bytes: int) -> bytes:
        return b"\xff\xd8" + _SOF + filling * (n_bytes // len(filling)) + b"\xff\xd9"

    return make


def _webp_chunks(n_bytes: int) -> bytes:
    image = b"VP8L" + struct.pack("<I", 5) + b"\x2f" + struct.pack("<I", 63 | 63 << 14) + b"\0"
    body = b"WEBP" + b"junk\0\0\0\0" * (n_bytes // 8) + image
    return b"RIFF" + struct.pack("<I", len(body)) + body


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def _png(between: bytes, side_px: int = 64) -> bytes:
    rows = (b"\0" + bytes(3 * side_px)) * side_px
    header = _chunk(b"IHDR", struct.pack(">IIBBBBB", side_px, side_px, 8, 2, 0, 0, 0))
    return (
        b"\x89PNG\r\n\x1a\n"
        + header
        + between
        + _chunk(b"IDAT", zlib.compress(rows))
        + _chunk(b"IEND", b"")
    )


def _png_chunks(n_bytes: int) -> bytes:
    return _png(_chunk(b"tEXt", b"") * (n_bytes // 12))


HEADER_BOMBS: dict[str, Callable[[int], bytes]] = {
    "jpeg scan headers": _jpeg(b"\xff\xda\x00\x02"),
    "jpeg scan headers and stuffing": _jpeg(b"\xff\xda\x00\x02\xff\x00"),
    "jpeg fill bytes": _jpeg(b"\xff"),
    "jpeg TEM markers": _jpeg(b"\xff\x01"),
    "jpeg empty comments": _jpeg(b"\xff\xfe\x00\x02"),
    "jpeg restart markers": _jpeg(b"\xff\xda\x00\x02" + b"\xff\xd0" * 30),
    "jpeg stuffing": lambda n_bytes: (
        _jpeg(b"\xff\xda\x00\x02")(4)[:-2] + b"\xff\0" * (n_bytes // 2) + b"\xff\xd9"
    ),
    "webp empty chunks": _webp_chunks,
    "png empty chunks": _png_chunks,
}
"""Family -> an image of about so many bytes, most of them for the reader of its header."""


def jpeg_of_scans(n_scans: int, side_px: int = 512) -> bytes:
    """A progressive JPEG that refines the same coefficients again and again."""
    image = np.random.default_rng(1).integers(0, 256, (side_px, side_px, 3), dtype=np.uint8)
    image = cv2.GaussianBlur(image, (0, 0), 8).astype(np.uint8)
    done, encoded = cv2.imencode(
        ".jpg", image, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_QUALITY, 30]
    )
    assert done
    data = encoded.tobytes()
    last = data.rindex(b"\xff\xda")
    n_before = data.count(b"\xff\xda") - 1
    return data[:last] + data[last:-2] * (n_scans - n_before) + b"\xff\xd9"


def png_of_text(n_chunks: int, mebibytes: float = 7.5) -> bytes:
    """A PNG with compressed texts that are a thousand times larger unpacked."""
    text = b"Comment\0\0" + zlib.compress(bytes(int(mebibytes * (1 << 20))), 9)
    return _png(_chunk(b"zTXt", text) * n_chunks)


def tiff_of_directory(
    entries: list[tuple[int, int, int, int]], order: str = "<", after: bytes = b""
) -> bytes:
    """A TIFF of one directory: tag, type, count, value or offset; ``after`` follows it."""
    data = (b"II" if order == "<" else b"MM") + struct.pack(order + "HIH", 42, 8, len(entries))
    for tag, kind, count, value in entries:
        data += struct.pack(
            order + ("HHIHxx" if kind in (3, 8) and count == 1 else "HHII"), tag, kind, count, value
        )
    return data + bytes(4) + after


def tiff_with_two_sizes(small_px: int = 64, large_px: int = 20_000) -> bytes:
    """A TIFF that declares its width and height twice: 64 px for one reader, 20,000 px for another."""
    entries = [
        (256, 4, 1, large_px),
        (256, 4, 1, small_px),
        (257, 4, 1, large_px),
        (257, 4, 1, small_px),
        (258, 3, 1, 8),
        (259, 3, 1, 1),
        (262, 3, 1, 1),
        (273, 4, 1, 8),
        (277, 3, 1, 1),
        (278, 4, 1, large_px),
        (279, 4, 1, small_px * small_px),
    ]
    return tiff_of_directory(entries, after=bytes(small_px * small_px))


def zero_tiff(
    side_px: int, dtype: str = "float64", bands: int = 4, rows: int | None = None
) -> bytes:
    """A small file of a large image: all zeros, in strips of so many rows (None: of one strip), deflated."""
    rows = rows or side_px
    strip = zlib.compress(bytes(rows * side_px * bands * np.dtype(dtype).itemsize), 9)
    return strip_tiff(side_px, dtype, bands=bands, rows=rows, strip=strip)


def strip_tiff(side_px: int, dtype: str, bands: int, rows: int, strip: bytes) -> bytes:
    """A deflated TIFF, all whose strips are the same bytes."""
    depth = np.dtype(dtype)
    n_strips = -(-side_px // rows)
    at = 8 + 2 + (13 if bands in (2, 4) else 12) * 12 + 4
    bits = struct.pack(f"<{bands}H", *[8 * depth.itemsize] * bands)
    kinds = struct.pack(f"<{bands}H", *[3 if depth.kind == "f" else 1] * bands)
    bits_at = at
    kinds_at = at + len(bits)
    offsets_at = kinds_at + len(kinds)
    counts_at = offsets_at + 4 * n_strips
    strip_at = counts_at + 4 * n_strips
    several = bands > 2
    entries = [
        (256, 4, 1, side_px),
        (257, 4, 1, side_px),
        (258, 3, bands, bits_at if several else 8 * depth.itemsize),
        (259, 3, 1, 8),
        (262, 3, 1, 2 if bands >= 3 else 1),
        (273, 4, n_strips, offsets_at if n_strips > 1 else strip_at),
        (277, 3, 1, bands),
        (278, 4, 1, rows),
        (279, 4, n_strips, counts_at if n_strips > 1 else len(strip)),
        (284, 3, 1, 1),
        *([(338, 3, 1, 0)] if bands in (2, 4) else []),
        (339, 3, bands, kinds_at if several else (3 if depth.kind == "f" else 1)),
        (317, 3, 1, 1),
    ]
    entries.sort()
    after = bits + kinds + struct.pack(f"<{n_strips}I", *[strip_at] * n_strips)
    after += struct.pack(f"<{n_strips}I", *[len(strip)] * n_strips) + strip
    return tiff_of_directory(entries, after=after)


def one_strip_tiff(pixels: NDArray[np.uint8]) -> bytes:
    """An honest TIFF of one strip."""
    buffer = io.BytesIO()
    Image.fromarray(pixels).save(buffer, "TIFF", tiffinfo={278: len(pixels)})
    return buffer.getvalue()


GENEROUS = 3.0
"""Times that a cost may be above proportion, or above the floors, before the check fails."""

FLOOR_S = 0.1
FLOOR_MIB = 64.0
"""Below them nothing is compared: a process has as much of its own."""

MIB = 1 << 20
_WORK = """
import json, sys, time
from vehanchor.errors import ImageError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.imagery.raster import Window

def peak_kib():  # not getrusage: a child inherits its parent's ru_maxrss
    return next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM"))

data = open(sys.argv[1], "rb").read()
before = peak_kib()
started = time.process_time()
try:
    with open_raster(data) as raster:
        raster.read(Window(0, 0, 16, 16))
    answer = "opened"
except ImageError as error:
    answer = error.code
taken = time.process_time() - started
held = peak_kib() - before
print(json.dumps([taken, held / 1024, answer]))
"""


class Family(NamedTuple):
    """A way to be expensive.

    Attributes:
        make: an image of a size.
        size: the smaller of two, of which the other is four times as large: bytes, scans, chunks or
            pixels.
        unit: of the size.
    """

    make: Callable[[int], bytes]
    size: int
    unit: str


class Cost(NamedTuple):
    """What opening an image took.

    Attributes:
        seconds: of the processor.
        mebibytes: of memory, above what the process held before.
        answer: ``opened``, or the code of the error.
    """

    seconds: float
    mebibytes: float
    answer: str


def _square(dtype: str, bands: int, rows: int | None) -> Callable[[int], bytes]:
    return lambda n_pixels: zero_tiff(int(n_pixels**0.5), dtype, bands=bands, rows=rows)


FAMILIES: dict[str, Family] = {
    **{name: Family(make, MIB, "bytes") for name, make in HEADER_BOMBS.items()},
    "progressive JPEG, 1 megapixel": Family(
        lambda n_scans: jpeg_of_scans(n_scans, 1024), 25, "scans"
    ),
    "progressive JPEG, beyond the limit": Family(
        lambda n_scans: jpeg_of_scans(n_scans, 1024), 625, "scans"
    ),
    "PNG with zipped texts": Family(png_of_text, 50, "texts"),
    "TIFF float64 RGBA, strips": Family(_square("float64", 4, 16), 16_000_000, "pixels"),
    "TIFF float64 grey, one strip": Family(_square("float64", 1, None), 16_000_000, "pixels"),
    "TIFF 16-bit RGBA, one strip": Family(_square("uint16", 4, None), 16_000_000, "pixels"),
    "TIFF 8-bit RGB, one strip": Family(_square("uint8", 3, None), 16_000_000, "pixels"),
    "TIFF of two sizes": Family(
        lambda side_px: tiff_with_two_sizes(large_px=side_px), 5_000, "pixels a side"
    ),
}


def _tiff_of_shared_tags(n_bytes: int) -> bytes:
    """4,000 unknown tags, all with the same bytes."""
    entries = [(256, 4, 1, 64), (257, 4, 1, 64), (258, 3, 1, 8), (262, 3, 1, 1)]
    shared = [(tag, 1, n_bytes - 60_000, 50_000) for tag in range(40_000, 44_000)]
    return tiff_of_directory([*entries, *shared], after=bytes(n_bytes - 12 * 4004 - 14))


FAMILIES["TIFF of shared tags"] = Family(_tiff_of_shared_tags, 1 << 18, "bytes")


def _noise(side_px: int, bands: int, dtype: str = "uint8") -> NDArray[Any]:
    """Smooth noise, which every format compresses somewhat; alpha is neither 0 nor 255 all over."""
    coarse = np.random.default_rng(1).integers(
        1, 255, (side_px // 8, side_px // 8, bands), dtype=np.uint8
    )
    fine = cv2.resize(coarse, (side_px, side_px), interpolation=cv2.INTER_LINEAR).reshape(
        side_px, side_px, bands
    )
    return fine.astype(dtype) * (1 if dtype == "uint8" else 4)


def _encoded(
    suffix: str, bands: int, dtype: str = "uint8", *parameters: int
) -> Callable[[int], bytes]:
    return lambda side_px: cv2.imencode(suffix, _noise(side_px, bands, dtype), parameters)[
        1
    ].tobytes()


_FAST_AVIF = cv2.IMWRITE_AVIF_SPEED, 10
_DEEP_AVIF = *_FAST_AVIF, cv2.IMWRITE_AVIF_DEPTH, 10
FORMATS: dict[str, Callable[[int], bytes]] = {
    "JPEG": _encoded(".jpg", 3),
    "JPEG, grey": _encoded(".jpg", 1),
    "JPEG, progressive": _encoded(".jpg", 3, "uint8", cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "PNG": _encoded(".png", 3),
    "PNG with alpha": _encoded(".png", 4),
    "PNG, grey": _encoded(".png", 1),
    "PNG, 16 bits": _encoded(".png", 3, "uint16"),
    "WebP": _encoded(".webp", 3, "uint8", cv2.IMWRITE_WEBP_QUALITY, 60),
    "WebP, lossless": _encoded(".webp", 3, "uint8", cv2.IMWRITE_WEBP_QUALITY, 101),
    "WebP with alpha": _encoded(".webp", 4, "uint8", cv2.IMWRITE_WEBP_QUALITY, 60),
    "AVIF": _encoded(".avif", 3, "uint8", *_FAST_AVIF),
    "AVIF, lossless": _encoded(".avif", 3, "uint8", *_FAST_AVIF, cv2.IMWRITE_AVIF_QUALITY, 100),
    "AVIF with alpha": _encoded(".avif", 4, "uint8", *_FAST_AVIF),
    "AVIF, 10 bits": _encoded(".avif", 3, "uint16", *_DEEP_AVIF),
    "AVIF with alpha, 10 bits": _encoded(".avif", 4, "uint16", *_DEEP_AVIF),
    "BMP": _encoded(".bmp", 3),
    "BMP with alpha": _encoded(".bmp", 4),
    "TIFF in strips": _encoded(".tif", 3),
    "TIFF in strips, 16 bits": _encoded(".tif", 3, "uint16"),
    "TIFF in strips, floats": _encoded(".tif", 3, "float32"),
    "TIFF of one strip": lambda side_px: one_strip_tiff(_noise(side_px, 3)),
    "TIFF of one strip with alpha": lambda side_px: one_strip_tiff(_noise(side_px, 4)),
    "TIFF of one strip, grey": lambda side_px: one_strip_tiff(_noise(side_px, 1)[..., 0]),
    "TIFF of one strip, 16 bits": lambda side_px: zero_tiff(side_px, "uint16", 3),
}
"""Honest images of every format that is decoded whole, by their sides in pixels."""


def cost(data: bytes, folder: Path) -> Cost:
    """Open an image in a new process."""
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
    """Whether the larger image costs more than in proportion, generously."""
    return large.seconds > GENEROUS * factor * max(
        small.seconds, FLOOR_S / factor
    ) or large.mebibytes > GENEROUS * factor * max(small.mebibytes, FLOOR_MIB / factor)
