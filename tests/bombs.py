"""Images that cost more than they weigh, each in any size: what an attacker sends."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable

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
    return b"\x89PNG\r\n\x1a\n" + header + between + _chunk(b"IDAT", zlib.compress(rows)) + _chunk(b"IEND", b"")


def _png_chunks(n_bytes: int) -> bytes:
    return _png(_chunk(b"tEXt", b"") * (n_bytes // 12))


HEADER_BOMBS: dict[str, Callable[[int], bytes]] = {
    "jpeg scan headers": _jpeg(b"\xff\xda\x00\x02"),
    "jpeg scan headers and stuffing": _jpeg(b"\xff\xda\x00\x02\xff\x00"),
    "jpeg fill bytes": _jpeg(b"\xff"),
    "jpeg TEM markers": _jpeg(b"\xff\x01"),
    "jpeg empty comments": _jpeg(b"\xff\xfe\x00\x02"),
    "jpeg restart markers": _jpeg(b"\xff\xda\x00\x02" + b"\xff\xd0" * 30),
    "jpeg stuffing": lambda n_bytes: _jpeg(b"\xff\xda\x00\x02")(4)[:-2] + b"\xff\0" * (n_bytes // 2) + b"\xff\xd9",
    "webp empty chunks": _webp_chunks,
    "png empty chunks": _png_chunks,
}
"""Family -> an image of about so many bytes, most of them for the reader of its header."""


def jpeg_of_scans(n_scans: int, side_px: int = 512) -> bytes:
    """A progressive JPEG that refines the same coefficients again and again."""
    image = np.random.default_rng(1).integers(0, 256, (side_px, side_px, 3), dtype=np.uint8)
    image = cv2.GaussianBlur(image, (0, 0), 8).astype(np.uint8)
    done, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1, cv2.IMWRITE_JPEG_QUALITY, 30])
    assert done
    data = encoded.tobytes()
    last = data.rindex(b"\xff\xda")
    n_before = data.count(b"\xff\xda") - 1
    return data[:last] + data[last:-2] * (n_scans - n_before) + b"\xff\xd9"


def png_of_text(n_chunks: int, mebibytes: float = 7.5) -> bytes:
    """A PNG with compressed texts that are a thousand times larger unpacked."""
    text = b"Comment\0\0" + zlib.compress(bytes(int(mebibytes * (1 << 20))), 9)
    return _png(_chunk(b"zTXt", text) * n_chunks)


def tiff_of_directory(entries: list[tuple[int, int, int, int]], order: str = "<", after: bytes = b"") -> bytes:
    """A TIFF of one directory: tag, type, count, value or offset; ``after`` follows it."""
    data = (b"II" if order == "<" else b"MM") + struct.pack(order + "HIH", 42, 8, len(entries))
    for tag, kind, count, value in entries:
        data += struct.pack(order + ("HHIHxx" if kind in (3, 8) and count == 1 else "HHII"), tag, kind, count, value)
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


def zero_tiff(side_px: int, dtype: str = "float64", bands: int = 4, rows: int | None = None) -> bytes:
    """A small file of a large image: all zeros, in strips of so many rows (None: of one strip), deflated."""
    rows = rows or side_px
    strip = zlib.compress(bytes(rows * side_px * bands * np.dtype(dtype).itemsize), 9)
    return strip_tiff(side_px, dtype, bands, rows, strip)


def strip_tiff(side_px: int, dtype: str, bands: int, rows: int, strip: bytes) -> bytes:
    """A deflated TIFF, all whose strips are the same bytes."""
    depth = np.dtype(dtype)
    n_strips = -(-side_px // rows)
    at = 8 + 2 + (13 if bands in (2, 4) else 12) * 12 + 4
    bits = struct.pack(f"<{bands}H", *[8 * depth.itemsize] * bands)
    kinds = struct.pack(f"<{bands}H", *[3 if depth.kind == "f" else 1] * bands)
    bits_at, kinds_at = at, at + len(bits)
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
