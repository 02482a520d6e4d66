"""EXIF and XMP blocks of an image file, found by walking segments and chunks without decoding pixels.

Files are untrusted: every walk has a fixed number of steps, and every block a fixed maximum size.
"""

from __future__ import annotations

import struct
import zlib
from contextlib import suppress
from typing import TYPE_CHECKING

from vehanchor.imagery.formats.header import is_tiff

if TYPE_CHECKING:
    from vehanchor.imagery.formats.ifd import ReadAt

MAX_XMP_BYTES = 1 << 18
"""Most bytes of all XMP of a file; a JPEG's segment holds 64 KiB, drones write 2 to 5."""

_MAX_EXIF_BYTES = 1 << 20
_MAX_SEGMENTS = 512  # before a JPEG's pixels; real files have a dozen
_MAX_CHUNKS = 4096

_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_EXIF_PREFIX = b"Exif\0\0"
_XMP_PREFIX = b"http://ns.adobe.com/xap/1.0/\0"
_FURTHER_XMP_PREFIX = b"http://ns.adobe.com/xmp/extension/\0"  # then the packet's digest, its size and an offset in it
_DIGEST_BYTES, _FURTHER_HEAD_BYTES = 32, 40
_PNG_XMP = b"XML:com.adobe.xmp\0"  # then two bytes on compression, a language and a translation, which end with 0
_PNG_CHUNK, _WEBP_CHUNK = ">I4s", "<4sI"
_JPEG_APP1, _JPEG_SOS, _JPEG_EOI = 0xE1, 0xDA, 0xD9


class MetadataBlocks:
    """Metadata blocks of a file, in its order.

    Attributes:
        exif: readers of the EXIF blocks, which are TIFF structures, with offsets from their first bytes.
        xmp: the XMP packets, ``MAX_XMP_BYTES`` together; what exceeds them is left out.
    """

    def __init__(self) -> None:
        self.exif: list[ReadAt] = []
        self.xmp: list[bytes] = []
        self._left = MAX_XMP_BYTES

    def add_exif(self, block: bytes) -> None:
        """Add an EXIF block, with or without JPEG's prefix."""
        data = block.removeprefix(_EXIF_PREFIX)
        self.exif.append(lambda offset, count: data[offset : offset + count])

    def add_xmp(self, packet: bytes) -> None:
        """Add an XMP packet, as far as there is room."""
        if packet and self._left > 0:
            self.xmp.append(packet[: self._left])
            self._left -= len(packet)


def find_metadata(read_at: ReadAt) -> MetadataBlocks:
    """Find the metadata blocks of a JPEG, PNG, WebP or TIFF; other formats have none, damaged files may lack some.

    The EXIF block of a TIFF is the file itself, with the XMP as one of its tags.
    """
    start = read_at(0, 16)
    found = MetadataBlocks()
    if start.startswith(b"\xff\xd8\xff"):
        _find_in_jpeg(read_at, found)
    elif start.startswith(_PNG_SIGNATURE):
        _find_in_chunks(read_at, found, 8, _PNG_CHUNK, 12)
    elif start.startswith(b"RIFF") and start[8:12] == b"WEBP":
        _find_in_chunks(read_at, found, 12, _WEBP_CHUNK, 8)
    elif is_tiff(start):
        found.exif.append(read_at)
    return found


def _find_in_jpeg(read_at: ReadAt, found: MetadataBlocks) -> None:
    further: dict[bytes, list[tuple[bytes, bytes]]] = {}
    position, n_further = 2, 0
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
            if body.startswith(_EXIF_PREFIX):
                found.add_exif(body)
            elif body.startswith(_XMP_PREFIX):
                found.add_xmp(body[len(_XMP_PREFIX) :])
            elif body.startswith(_FURTHER_XMP_PREFIX) and n_further < MAX_XMP_BYTES:
                part = body[len(_FURTHER_XMP_PREFIX) :]
                offset, content = part[_DIGEST_BYTES + 4 : _FURTHER_HEAD_BYTES], part[_FURTHER_HEAD_BYTES:]
                further.setdefault(part[:_DIGEST_BYTES], []).append((offset, content))
                n_further += len(content)
        position += 2 + length
    for parts in further.values():
        found.add_xmp(b"".join(content for _, content in sorted(parts)))


def _find_in_chunks(read_at: ReadAt, found: MetadataBlocks, position: int, form: str, around: int) -> None:
    """Walk the chunks of a PNG or WebP; ``around`` bytes of a chunk are not its content."""
    for _ in range(_MAX_CHUNKS):
        head = read_at(position, 8)
        if len(head) < 8:
            break
        first, second = struct.unpack(form, head)
        kind, length = (second, first) if isinstance(second, bytes) else (first, second)
        if kind == b"IEND":
            break
        if kind in (b"eXIf", b"EXIF") and length <= _MAX_EXIF_BYTES:
            found.add_exif(read_at(position + 8, length))
        elif kind == b"XMP ":
            found.add_xmp(read_at(position + 8, min(length, MAX_XMP_BYTES)))
        elif kind == b"iTXt":
            found.add_xmp(_xmp_of_text(read_at(position + 8, min(length, MAX_XMP_BYTES))))
        position += around + length + (length & 1 if form == _WEBP_CHUNK else 0)


def _xmp_of_text(chunk: bytes) -> bytes:
    """Take the XMP packet of a PNG's text chunk; empty if it holds another text."""
    if not chunk.startswith(_PNG_XMP):
        return b""
    compressed, rest = chunk[len(_PNG_XMP) : len(_PNG_XMP) + 1], chunk[len(_PNG_XMP) + 2 :]
    packet = rest.split(b"\0", 2)[-1]
    if compressed != b"\1":
        return packet
    with suppress(zlib.error):
        return zlib.decompressobj().decompress(packet, MAX_XMP_BYTES)
    return b""
