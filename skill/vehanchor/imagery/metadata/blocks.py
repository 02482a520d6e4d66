"""EXIF and XMP blocks of an image file, found by walking segments and chunks without decoding pixels.

Files are untrusted: every walk has a fixed number of steps, and every block a fixed maximum size.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.imagery.formats.header import is_tiff

if TYPE_CHECKING:
    from vehanchor.imagery.formats.ifd import ReadAt

MAX_XMP_BYTES = 1 << 18  # a JPEG's segment holds 64 KiB; drones write 2 to 5
_MAX_EXIF_BYTES = 1 << 20
_MAX_SEGMENTS = 512  # before a JPEG's pixels; real files have a dozen
_MAX_CHUNKS = 4096

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_EXIF_PREFIX = b"Exif\0\0"
_XMP_PREFIX = b"http://ns.adobe.com/xap/1.0/\0"
_PNG_XMP_PREFIX = b"XML:com.adobe.xmp\0\0\0\0\0"  # keyword, not compressed, no language, no translation
_JPEG_APP1, _JPEG_SOS, _JPEG_EOI = 0xE1, 0xDA, 0xD9


class MetadataBlocks(NamedTuple):
    """Metadata blocks of a file.

    Attributes:
        exif: reads the EXIF block, a TIFF structure, with offsets from its first byte; None without EXIF.
        xmp: the XMP packet; None without one, or if it exceeds ``MAX_XMP_BYTES``.
    """

    exif: ReadAt | None = None
    xmp: bytes | None = None


def find_metadata(read_at: ReadAt) -> MetadataBlocks:
    """Find the metadata blocks of a JPEG, PNG, WebP or TIFF; other formats have none, damaged files may lack some.

    The EXIF block of a TIFF is the file itself, with the XMP as one of its tags.
    """
    start = read_at(0, 16)
    if start.startswith(b"\xff\xd8\xff"):
        return _find_in_jpeg(read_at)
    if start.startswith(_PNG_SIGNATURE):
        return _find_in_png(read_at)
    if start.startswith(b"RIFF") and start[8:12] == b"WEBP":
        return _find_in_webp(read_at)
    if is_tiff(start):
        return MetadataBlocks(exif=read_at)
    return MetadataBlocks()


def _read_bytes(data: bytes) -> ReadAt:
    return lambda offset, count: data[offset : offset + count]


def _find_in_jpeg(read_at: ReadAt) -> MetadataBlocks:
    exif, xmp, position = None, None, 2
    for _ in range(_MAX_SEGMENTS):
        head = read_at(position, 4)
        if len(head) < 4 or head[0] != 0xFF or head[1] in (_JPEG_SOS, _JPEG_EOI):
            break
        if head[1] == 0xFF:  # fill byte
            position += 1
            continue
        length = int.from_bytes(head[2:], "big")
        if length < 2:
            break
        if head[1] == _JPEG_APP1:
            body = read_at(position + 4, length - 2)
            if exif is None and body.startswith(_EXIF_PREFIX):
                exif = _read_bytes(body[len(_EXIF_PREFIX) :])
            elif xmp is None and body.startswith(_XMP_PREFIX):
                xmp = body[len(_XMP_PREFIX) :]
        position += 2 + length
    return MetadataBlocks(exif, xmp)


def _find_in_png(read_at: ReadAt) -> MetadataBlocks:
    exif, xmp, position = None, None, 8
    for _ in range(_MAX_CHUNKS):
        head = read_at(position, 8)
        if len(head) < 8:
            break
        length, kind = struct.unpack(">I4s", head)
        if kind == b"IEND":
            break
        if kind == b"eXIf" and exif is None and length <= _MAX_EXIF_BYTES:
            exif = _read_bytes(read_at(position + 8, length))
        elif kind == b"iTXt" and xmp is None and length <= MAX_XMP_BYTES:
            body = read_at(position + 8, length)
            if body.startswith(_PNG_XMP_PREFIX):
                xmp = body[len(_PNG_XMP_PREFIX) :]
        position += length + 12
    return MetadataBlocks(exif, xmp)


def _find_in_webp(read_at: ReadAt) -> MetadataBlocks:
    exif, xmp, position = None, None, 12
    for _ in range(_MAX_CHUNKS):
        head = read_at(position, 8)
        if len(head) < 8:
            break
        kind, length = struct.unpack("<4sI", head)
        if kind == b"EXIF" and exif is None and length <= _MAX_EXIF_BYTES:
            exif = _read_bytes(read_at(position + 8, length).removeprefix(_EXIF_PREFIX))
        elif kind == b"XMP " and xmp is None and length <= MAX_XMP_BYTES:
            xmp = read_at(position + 8, length)
        position += 8 + length + (length & 1)
    return MetadataBlocks(exif, xmp)
