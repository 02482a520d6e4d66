"""EXIF and XMP blocks of an image file, at the offsets in its header.

Files are untrusted, so the number of blocks and their bytes have fixed limits.
"""

from __future__ import annotations

import zlib
from contextlib import suppress
from typing import TYPE_CHECKING

from vehanchor.imagery.formats.ifd import TIFF_SIGNATURES, in_memory
from vehanchor.imagery.formats.jpeg import EXIF_PREFIX

if TYPE_CHECKING:
    from vehanchor.imagery.formats.ifd import ReadAt
    from vehanchor.imagery.formats.image_header import ImageHeader

MAX_XMP_BYTES = 1 << 18
"""Maximum number of bytes of all XMP in a file.

A JPEG's segment holds 64 KiB, and drones write 2 to 5 KiB.
"""

_MAX_BLOCK_BYTES = 1 << 20
_MAX_BLOCKS = 512
"""Maximum number of blocks; real files have a dozen."""

_XMP_PREFIX = b"http://ns.adobe.com/xap/1.0/\0"
_EXTENDED_XMP_PREFIX = b"http://ns.adobe.com/xmp/extension/\0"
"""Start of a part of an XMP packet that is too long for one segment of a JPEG.

The packet's digest (32 bytes), its size and the part's offset in it (4 bytes each) follow.
"""

_DIGEST_BYTES = 32
_OFFSET_START = 36
_EXTENDED_HEAD_BYTES = 40

_PNG_XMP = b"XML:com.adobe.xmp\0"
"""Keyword of a PNG's text chunk with XMP.

Two bytes on compression, a language and a translation follow. Both texts end with 0.
"""


def metadata_blocks(read_at: ReadAt, header: ImageHeader) -> tuple[list[ReadAt], list[bytes]]:
    """Read the metadata blocks of a file, in its order.

    Returns:
        Readers of the EXIF blocks, which are TIFF structures, with offsets from their first bytes,
        and the XMP packets. The EXIF of a TIFF is the file itself, with the XMP as one of its tags.
    """
    exif = [read_at] if header.tiff else []
    xmp: list[bytes] = []
    extended_parts: dict[bytes, dict[bytes, bytes]] = {}
    for start, n_bytes in header.metadata[:_MAX_BLOCKS]:
        block = read_at(start, min(n_bytes, _MAX_BLOCK_BYTES))
        if block.startswith((EXIF_PREFIX, *TIFF_SIGNATURES)):
            exif.append(in_memory(block.removeprefix(EXIF_PREFIX)))
        elif block.startswith(_EXTENDED_XMP_PREFIX):
            part = block.removeprefix(_EXTENDED_XMP_PREFIX)
            digest = part[:_DIGEST_BYTES]
            offset = part[_OFFSET_START:_EXTENDED_HEAD_BYTES]
            if int.from_bytes(offset, "big") < MAX_XMP_BYTES:
                parts_of_packet = extended_parts.setdefault(digest, {})
                parts_of_packet[offset] = part[_EXTENDED_HEAD_BYTES:]
        elif sum(map(len, xmp)) >= MAX_XMP_BYTES:
            continue
        elif block.startswith(_PNG_XMP):
            xmp.append(_packet_of_text_chunk(block))
        elif block.startswith((_XMP_PREFIX, b"<")) or header.format == "WebP":
            xmp.append(block.removeprefix(_XMP_PREFIX))
    # Parts of a packet come in any order; their offsets, big-endian, sort as numbers do.
    for parts in extended_parts.values():
        in_order = [parts[offset] for offset in sorted(parts)]
        xmp.append(b"".join(in_order))
    return exif, xmp


def _packet_of_text_chunk(chunk: bytes) -> bytes:
    """Extract the XMP packet from a PNG's text chunk; empty if it is damaged."""
    after_keyword = chunk.removeprefix(_PNG_XMP)
    is_compressed = after_keyword[:1] == b"\1"
    texts = after_keyword[2:].split(b"\0", 2)
    packet = texts[-1]
    if not is_compressed:
        return packet
    with suppress(zlib.error):
        return zlib.decompressobj().decompress(packet, MAX_XMP_BYTES)
    return b""
