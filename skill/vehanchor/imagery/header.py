"""What an image file says about itself, read from its bytes without decoding a pixel.

Limits have to be checked before a decoder allocates anything, OpenCV neither tells the orientation nor, in some
versions, that a JPEG was cut off, and only a TIFF's tags say whether OpenCV can decode it at all.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable
from dataclasses import dataclass

from vehanchor.errors import ImageDecodeError

__all__ = ["ImageHeader", "ReadAt", "TiffLayout", "is_tiff", "read_header"]

ReadAt = Callable[[int, int], bytes]
"""``read_at(offset, count)`` gives up to ``count`` bytes, fewer only where the file ends."""

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_TIFF_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # classic and BigTIFF, either byte order
_EXIF_PREFIX = b"Exif\0\0"
_MAX_EXIF_BYTES = 1 << 16  # the first directory, with the orientation, stands at the start; JPEG holds no more anyway

_JPEG_SOF = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # DHT, JPG and DAC share the range
_JPEG_STANDALONE = frozenset({0x01, *range(0xD0, 0xD8)})  # TEM and RSTn carry no length
_JPEG_SOS, _JPEG_EOI, _JPEG_APP1 = 0xDA, 0xD9, 0xE1
# In entropy-coded data 0xFF is followed by 0 (stuffing), a restart marker, or a fill byte; all else is a marker.
_JPEG_MARKER_IN_SCAN = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
_SCAN_CHUNK_BYTES = 1 << 20

_TAG_WIDTH, _TAG_HEIGHT, _TAG_BITS, _TAG_PHOTOMETRIC = 256, 257, 258, 262
_TAG_ORIENTATION, _TAG_SAMPLES, _TAG_PLANAR, _TAG_SAMPLE_FORMAT = 274, 277, 284, 339
_GEO_TAGS = frozenset({33550, 34264, 34735})  # ModelPixelScale, ModelTransformation, GeoKeyDirectory
_TIFF_TAGS = _GEO_TAGS | {
    _TAG_WIDTH,
    _TAG_HEIGHT,
    _TAG_BITS,
    _TAG_PHOTOMETRIC,
    _TAG_ORIENTATION,
    _TAG_SAMPLES,
    _TAG_PLANAR,
    _TAG_SAMPLE_FORMAT,
}
_TIFF_INTEGER_TYPES = {1: "B", 3: "H", 4: "I", 16: "Q"}
_MAX_IFD_ENTRIES = 4096  # a real directory has some dozens
_MAX_TAG_VALUES = 64  # one per band; what is equal in the first 64 is taken to be equal in all


@dataclass(frozen=True)
class TiffLayout:
    """How a TIFF stores its pixels.

    Attributes:
        bands: samples per pixel.
        bits: bits of each band.
        sample_format: 1 unsigned, 2 signed, 3 float.
        photometric: 0 white is zero, 1 black is zero, 2 RGB, 3 palette, 5 CMYK, 6 YCbCr, 8 Lab.
        planar: bands are stored one after the other.
        georeferenced: it carries GeoTIFF tags.
    """

    bands: int
    bits: tuple[int, ...]
    sample_format: int
    photometric: int
    planar: bool
    georeferenced: bool


@dataclass(frozen=True)
class ImageHeader:
    """The declared form of an encoded image.

    Attributes:
        format: JPEG, PNG, TIFF, WebP or BMP.
        width_px: declared width as stored, before the orientation is applied.
        height_px: declared height as stored.
        orientation: EXIF orientation, 1 to 8; 1 where none or a meaningless one is given.
        complete: False if the file ends before its format's end mark (known for JPEG, PNG, WebP).
        tiff: the layout of a TIFF, None for other formats.
    """

    format: str
    width_px: int
    height_px: int
    orientation: int = 1
    complete: bool = True
    tiff: TiffLayout | None = None


def is_tiff(start: bytes) -> bool:
    """True if these first bytes (at least four) open a TIFF or BigTIFF."""
    return start[:4] in _TIFF_SIGNATURES


def read_header(read_at: ReadAt) -> ImageHeader:
    """Read format, declared size, orientation and completeness.

    Raises:
        ImageDecodeError: not one of the five formats, or the header itself is broken.
    """
    start = read_at(0, 32)
    if start.startswith(b"\xff\xd8\xff"):
        name, parse = "JPEG", _read_jpeg
    elif start.startswith(_PNG_SIGNATURE):
        name, parse = "PNG", _read_png
    elif is_tiff(start):
        name, parse = "TIFF", _read_tiff
    elif start.startswith(b"RIFF") and start[8:12] == b"WEBP":
        name, parse = "WebP", _read_webp
    elif start.startswith(b"BM"):
        name, parse = "BMP", _read_bmp
    else:
        raise ImageDecodeError(f"not a JPEG, PNG, TIFF, WebP or BMP image: it starts with {start[:8]!r}")
    try:
        return parse(read_at)
    except struct.error:
        raise ImageDecodeError(f"the {name} ends within its header: truncated") from None


def _read_jpeg(read_at: ReadAt) -> ImageHeader:
    size: tuple[int, int] | None = None
    orientation = 1
    complete = False
    position = 2
    while True:
        start = read_at(position, 2)
        if len(start) < 2 or start[0] != 0xFF:
            break
        marker = start[1]
        if marker == 0xFF:  # fill byte
            position += 1
            continue
        if marker == _JPEG_EOI:
            complete = True
            break
        position += 2
        if marker in _JPEG_STANDALONE:
            continue
        head = read_at(position, 8)
        if len(head) < 2:
            break
        if marker in _JPEG_SOF and size is None:
            height, width = struct.unpack_from(">HH", head, 3)
            size = width, height
        elif marker == _JPEG_APP1 and head[2:8] == _EXIF_PREFIX:
            orientation = _exif_orientation(read_at(position + 8, int.from_bytes(head[:2], "big") - 8))
        position += int.from_bytes(head[:2], "big")
        if marker == _JPEG_SOS:
            position = _next_jpeg_marker(read_at, position)
    if size is None:
        raise ImageDecodeError("the JPEG has no frame header: truncated or damaged")
    return ImageHeader("JPEG", *size, orientation=orientation, complete=complete)


def _next_jpeg_marker(read_at: ReadAt, position: int) -> int:
    while True:
        chunk = read_at(position, _SCAN_CHUNK_BYTES)
        found = _JPEG_MARKER_IN_SCAN.search(chunk)
        if found:
            return position + found.start()
        if len(chunk) < _SCAN_CHUNK_BYTES:
            return position + len(chunk)
        position += len(chunk) - 1  # a marker may straddle two chunks


def _read_png(read_at: ReadAt) -> ImageHeader:
    length, kind, width, height = struct.unpack(">I4sII", read_at(8, 16))
    if kind != b"IHDR" or length != 13:
        raise ImageDecodeError("the PNG does not begin with its IHDR chunk: damaged")
    orientation = 1
    complete = False
    position = 8
    while len(head := read_at(position, 8)) == 8:
        length, kind = struct.unpack(">I4s", head)
        if kind == b"IEND":
            complete = len(read_at(position + 8, 4)) == 4
            break
        if kind == b"eXIf":
            orientation = _exif_orientation(read_at(position + 8, min(length, _MAX_EXIF_BYTES)))
        position += length + 12
    return ImageHeader("PNG", width, height, orientation=orientation, complete=complete)


def _read_webp(read_at: ReadAt) -> ImageHeader:
    (riff_bytes,) = struct.unpack("<I", read_at(4, 4))
    end = riff_bytes + 8
    complete = len(read_at(end - 1, 1)) == 1
    size: tuple[int, int] | None = None
    orientation = 1
    position = 12
    while position < end and len(head := read_at(position, 8)) == 8:
        kind, length = struct.unpack("<4sI", head)
        body = read_at(position + 8, 10)
        if size is None and kind == b"VP8X":
            size = 1 + int.from_bytes(body[4:7], "little"), 1 + int.from_bytes(body[7:10], "little")
        elif size is None and kind == b"VP8 ":
            width, height = struct.unpack_from("<HH", body, 6)
            size = width & 0x3FFF, height & 0x3FFF
        elif size is None and kind == b"VP8L":
            (packed,) = struct.unpack_from("<I", body, 1)
            size = 1 + (packed & 0x3FFF), 1 + (packed >> 14 & 0x3FFF)
        elif kind == b"EXIF":
            payload = read_at(position + 8, min(length, _MAX_EXIF_BYTES))
            orientation = _exif_orientation(payload.removeprefix(_EXIF_PREFIX))
        position += 8 + length + (length & 1)
    if size is None:
        raise ImageDecodeError("the WebP holds no image chunk: truncated or damaged")
    return ImageHeader("WebP", *size, orientation=orientation, complete=complete)


def _read_bmp(read_at: ReadAt) -> ImageHeader:
    (header_bytes,) = struct.unpack("<I", read_at(14, 4))
    if header_bytes == 12:  # OS/2
        width, height = struct.unpack("<HH", read_at(18, 4))
    else:
        width, height = struct.unpack("<ii", read_at(18, 8))
    return ImageHeader("BMP", abs(width), abs(height))  # a negative height means rows from top to bottom


def _read_tiff(read_at: ReadAt) -> ImageHeader:
    tags = _read_ifd(read_at)
    try:
        width, height = tags[_TAG_WIDTH][0], tags[_TAG_HEIGHT][0]
    except (KeyError, IndexError):
        raise ImageDecodeError("the TIFF's first directory declares no width and height: damaged") from None

    def first(tag: int, default: int) -> int:
        return (tags.get(tag) or (default,))[0]

    layout = TiffLayout(
        bands=first(_TAG_SAMPLES, 1),
        bits=tags.get(_TAG_BITS) or (1,),
        sample_format=first(_TAG_SAMPLE_FORMAT, 1),
        photometric=first(_TAG_PHOTOMETRIC, 1),
        planar=first(_TAG_PLANAR, 1) == 2,
        georeferenced=not _GEO_TAGS.isdisjoint(tags),
    )
    return ImageHeader("TIFF", width, height, orientation=_orientation(tags), tiff=layout)


def _read_ifd(read_at: ReadAt) -> dict[int, tuple[int, ...]]:
    """The known tags of a TIFF's first directory; those that hold no integers have no values here."""
    head = read_at(0, 16)
    order = {b"II": "<", b"MM": ">"}.get(head[:2])
    if order is None:
        raise ImageDecodeError("the TIFF directory names no byte order: damaged")
    (version,) = struct.unpack_from(order + "H", head, 2)
    if version == 43:  # BigTIFF
        (offset,) = struct.unpack_from(order + "Q", head, 8)
        count_format, entry_format, value_bytes = order + "Q", order + "HHQ", 8
    else:
        (offset,) = struct.unpack_from(order + "I", head, 4)
        count_format, entry_format, value_bytes = order + "H", order + "HHI", 4
    count_bytes = struct.calcsize(count_format)
    (n_entries,) = struct.unpack(count_format, read_at(offset, count_bytes))
    if n_entries > _MAX_IFD_ENTRIES:
        raise ImageDecodeError(f"the TIFF directory declares {n_entries} entries: damaged")
    value_at = struct.calcsize(entry_format)
    entry_bytes = value_at + value_bytes
    table = read_at(offset + count_bytes, n_entries * entry_bytes)
    tags: dict[int, tuple[int, ...]] = {}
    for start in range(0, n_entries * entry_bytes, entry_bytes):
        tag, kind, count = struct.unpack_from(entry_format, table, start)
        if tag not in _TIFF_TAGS:
            continue
        if kind not in _TIFF_INTEGER_TYPES:
            tags[tag] = ()
            continue
        values = f"{order}{min(count, _MAX_TAG_VALUES)}{_TIFF_INTEGER_TYPES[kind]}"
        inline = count * struct.calcsize(order + _TIFF_INTEGER_TYPES[kind]) <= value_bytes
        if inline:
            tags[tag] = struct.unpack_from(values, table, start + value_at)
        else:
            (at,) = struct.unpack_from(order + ("I" if value_bytes == 4 else "Q"), table, start + value_at)
            tags[tag] = struct.unpack(values, read_at(at, struct.calcsize(values)))
    return tags


def _exif_orientation(payload: bytes) -> int:
    try:
        return _orientation(_read_ifd(lambda offset, count: payload[offset : offset + count]))
    except (struct.error, ImageDecodeError):  # damaged metadata does not make the pixels unusable
        return 1


def _orientation(tags: dict[int, tuple[int, ...]]) -> int:
    value = (tags.get(_TAG_ORIENTATION) or (1,))[0]
    return value if 1 <= value <= 8 else 1
