"""Chunks of a PNG (ISO/IEC 15948)."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from vehanchor.errors import ImageDecodeError, ImageTooLargeError
from vehanchor.imagery.formats.ifd import MAX_EXIF_BYTES, exif_orientation
from vehanchor.imagery.formats.image_format import ImageFormat, starts_with
from vehanchor.imagery.formats.image_header import COPIES, ImageHeader

if TYPE_CHECKING:
    from vehanchor.imagery.formats.ifd import ReadAt

_SIGNATURE = b"\x89PNG\r\n\x1a\n"

_BANDS = {0: 1, 2: 3}
"""Decoded bands of grey and RGB; all others, and these with transparency, can become four."""

_ESSENTIAL_CHUNKS = frozenset({b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND"})
_MAX_CHUNKS = 100_000
"""Maximum number of chunks; 512 MiB in chunks of 8 KiB, as libpng writes them, are 65,536."""


def read_png(read_at: ReadAt) -> ImageHeader:
    """Read the header of a PNG from its chunks.

    Raises:
        ImageDecodeError: the file is damaged.
        ImageTooLargeError: there are too many chunks.
        struct.error: the file ends within its header.
    """
    length, kind, width, height, depth, colour = struct.unpack(">I4sIIBB", read_at(8, 18))
    if kind != b"IHDR" or length != 13:
        raise ImageDecodeError("the PNG does not begin with its IHDR chunk: damaged")
    orientation = 1
    complete = False
    n_frames = 1
    metadata: list[tuple[int, int]] = []
    position = len(_SIGNATURE)
    n_chunks = 0
    while True:
        head = read_at(position, 8)
        if len(head) < 8:
            break
        n_chunks += 1
        if n_chunks > _MAX_CHUNKS:
            raise ImageTooLargeError(f"the PNG has more than {_MAX_CHUNKS} chunks; save it again")
        length, kind = struct.unpack(">I4s", head)
        content = position + 8
        if kind == b"IHDR" and n_chunks > 1:
            raise ImageDecodeError("the PNG declares its size twice: damaged")
        if kind == b"IEND":
            # OpenCV allocates whatever length the end mark declares.
            has_checksum = len(read_at(content, 4)) == 4
            complete = length == 0 and has_checksum
            break
        if kind == b"acTL":
            (n_frames,) = struct.unpack(">I", read_at(content, 4))
        if kind in (b"eXIf", b"iTXt"):
            metadata.append((content, length))
        if kind == b"eXIf":
            exif = read_at(content, min(length, MAX_EXIF_BYTES))
            orientation = exif_orientation(exif)
        position += length + 12  # with length, kind and checksum
    sample_bytes = 2 if depth == 16 else 1
    pixel_bytes = _BANDS.get(colour, 4) * sample_bytes
    return ImageHeader(
        "PNG",
        width,
        height,
        orientation=orientation,
        complete=complete,
        decoding_bytes=COPIES * width * height * pixel_bytes,
        n_frames=n_frames,
        metadata=tuple(metadata),
    )


def without_ancillary_chunks(png: bytes) -> bytes:
    """Remove texts, profiles, animation and what follows the end from a PNG that has been checked.

    libpng would unpack a thousand texts of 8 MB, compressed a thousandfold, and write a line to
    stderr for every chunk that it rejects. Without pixels, OpenCV would read beyond the end.
    """
    # Essential chunks that follow each other are copied as one run.
    runs = [png[: len(_SIGNATURE)]]
    run_start = len(_SIGNATURE)
    position = run_start
    while True:
        head = png[position : position + 8]
        if len(head) < 8:
            break
        length, kind = struct.unpack(">I4s", head)
        chunk_end = position + length + 12
        if kind not in _ESSENTIAL_CHUNKS:
            runs.append(png[run_start:position])
            run_start = chunk_end
        position = chunk_end
        if kind == b"IEND":
            break
    has_nothing_to_remove = len(runs) == 1 and position >= len(png)
    if has_nothing_to_remove:  # the file is not copied
        return png
    runs.append(png[run_start:position])
    return b"".join(runs)


PNG = ImageFormat(
    name="PNG",
    suffixes=(".png",),
    recognises=starts_with(_SIGNATURE),
    read_header=read_png,
    has_alpha=True,
)
