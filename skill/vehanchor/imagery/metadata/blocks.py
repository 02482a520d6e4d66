"""EXIF and XMP blocks of an image file, at the places that its header found.

Files are untrusted: the number of blocks, and their bytes, have fixed limits.
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
"""Most bytes of all XMP of a file; a JPEG's segment holds 64 KiB, drones write 2 to 5."""

_MAX_BLOCK_BYTES = 1 << 20
_MAX_BLOCKS = 512  # real files have a dozen
_XMP_PREFIX = b"http://ns.adobe.com/xap/1.0/\0"
# then the packet's digest, its size and an offset in it
_FURTHER_XMP_PREFIX = b"http://ns.adobe.com/xmp/extension/\0"
_DIGEST_BYTES = 32
_FURTHER_HEAD_BYTES = 40
# then two bytes on compression, a language and a translation, which end with 0
_PNG_XMP = b"XML:com.adobe.xmp\0"


def metadata_blocks(read_at: ReadAt, header: ImageHeader) -> tuple[list[ReadAt], list[bytes]]:
    """Read the metadata blocks of a file, in its order.

    Returns:
        Readers of the EXIF blocks, which are TIFF structures, with offsets from their first bytes,
        and the XMP packets. The EXIF of a TIFF is the file itself, with the XMP as one of its tags.
    """
    exif = [read_at] if header.tiff else []
    xmp: list[bytes] = []
    further: dict[bytes, dict[bytes, bytes]] = {}
    for offset, n_bytes in header.metadata[:_MAX_BLOCKS]:
        block = read_at(offset, min(n_bytes, _MAX_BLOCK_BYTES))
        if block.startswith((EXIF_PREFIX, *TIFF_SIGNATURES)):
            exif.append(in_memory(block.removeprefix(EXIF_PREFIX)))
        elif block.startswith(_FURTHER_XMP_PREFIX):
            part = block[len(_FURTHER_XMP_PREFIX) :]
            at = part[_DIGEST_BYTES + 4 : _FURTHER_HEAD_BYTES]
            content = part[_FURTHER_HEAD_BYTES:]
            if int.from_bytes(at, "big") < MAX_XMP_BYTES:
                further.setdefault(part[:_DIGEST_BYTES], {})[at] = content
        elif sum(map(len, xmp)) >= MAX_XMP_BYTES:
            continue
        elif block.startswith(_PNG_XMP):
            xmp.append(_xmp_of_text(block))
        elif block.startswith((_XMP_PREFIX, b"<")) or header.format == "WebP":
            xmp.append(block.removeprefix(_XMP_PREFIX))
    return exif, xmp + [b"".join(parts[at] for at in sorted(parts)) for parts in further.values()]


def _xmp_of_text(chunk: bytes) -> bytes:
    """Take the XMP packet of a PNG's text chunk; empty if it is damaged."""
    compressed = chunk[len(_PNG_XMP) : len(_PNG_XMP) + 1]
    rest = chunk[len(_PNG_XMP) + 2 :]
    packet = rest.split(b"\0", 2)[-1]
    if compressed != b"\1":
        return packet
    with suppress(zlib.error):
        return zlib.decompressobj().decompress(packet, MAX_XMP_BYTES)
    return b""
