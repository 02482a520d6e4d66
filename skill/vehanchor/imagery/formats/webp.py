"""Chunks of a WebP (RFC 9649)."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from vehanchor.errors import ImageDecodeError, ImageTooLargeError
from vehanchor.imagery.formats.ifd import MAX_EXIF_BYTES, exif_orientation
from vehanchor.imagery.formats.image_format import ImageFormat
from vehanchor.imagery.formats.image_header import ImageHeader
from vehanchor.imagery.formats.jpeg import EXIF_PREFIX, MAX_SEGMENTS

if TYPE_CHECKING:
    from vehanchor.imagery.formats.ifd import ReadAt

_PIXEL_BYTES = 9
"""Memory for decoding: two copies of four bands, and alpha (measured in tests/bombs.py)."""


def read_webp(read_at: ReadAt) -> ImageHeader:
    """Read the header of a WebP from its chunks.

    Raises:
        ImageDecodeError: the file has no size, or two different ones.
        ImageTooLargeError: there are too many chunks.
        struct.error: the file ends within its header.
    """
    (riff_bytes,) = struct.unpack("<I", read_at(4, 4))
    end = riff_bytes + 8
    complete = len(read_at(end - 1, 1)) == 1
    sizes: set[tuple[int, int]] = set()
    orientation = 1
    metadata: list[tuple[int, int]] = []
    position = 12
    n_chunks = 0
    n_frames = 0
    while position < end:
        head = read_at(position, 8)
        if len(head) < 8:
            break
        n_chunks += 1
        if n_chunks > MAX_SEGMENTS:
            raise ImageTooLargeError(f"the WebP has more than {MAX_SEGMENTS} chunks; save it again")
        kind, length = struct.unpack("<4sI", head)
        content = position + 8
        if kind in (b"VP8X", b"VP8 ", b"VP8L"):
            sizes.add(_chunk_size(kind, read_at(content, 10)))
        elif kind in (b"EXIF", b"XMP "):
            metadata.append((content, length))
        if kind == b"ANMF":
            n_frames += 1
        if kind == b"EXIF":
            exif = read_at(content, min(length, MAX_EXIF_BYTES))
            orientation = exif_orientation(exif.removeprefix(EXIF_PREFIX))
        position += 8 + length + length % 2  # chunks begin at even offsets
    if not sizes:
        raise ImageDecodeError("the WebP holds no image chunk: truncated or damaged")
    if len(sizes) > 1:
        raise ImageDecodeError("the WebP holds two different sizes: damaged")
    width, height = sizes.pop()
    return ImageHeader(
        "WebP",
        width,
        height,
        orientation=orientation,
        complete=complete,
        decoding_bytes=_PIXEL_BYTES * width * height,
        n_frames=max(1, n_frames),
        metadata=tuple(metadata),
    )


def _chunk_size(kind: bytes, content: bytes) -> tuple[int, int]:
    """Read width and height from the first 10 bytes of a chunk.

    Raises:
        struct.error: the file ends within the chunk.
    """
    if kind == b"VP8X":  # the whole canvas, 24 bits a side
        width = 1 + int.from_bytes(content[4:7], "little")
        height = 1 + int.from_bytes(content[7:10], "little")
        return width, height
    if kind == b"VP8 ":  # lossy: 14 bits a side, below two bits of scaling
        width, height = struct.unpack_from("<HH", content, 6)
        return width & 0x3FFF, height & 0x3FFF
    # Lossless: 14 bits a side, one after the other.
    (packed,) = struct.unpack_from("<I", content, 1)
    width = 1 + (packed & 0x3FFF)
    height = 1 + (packed >> 14 & 0x3FFF)
    return width, height


def _is_webp(start: bytes) -> bool:
    return start[:4] == b"RIFF" and start[8:12] == b"WEBP"


WEBP = ImageFormat(
    name="WebP",
    suffixes=(".webp",),
    recognises=_is_webp,
    read_header=read_webp,
    has_alpha=True,
)
