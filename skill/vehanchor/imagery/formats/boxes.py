"""Boxes of ISO base media files: AVIF, HEIC and JPEG 2000."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.errors import ImageDecodeError, ImageTooLargeError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vehanchor.imagery.formats.ifd import ReadAt

_MAX_BOXES = 1000  # in one box; real files have a dozen
_STILL = {b"avif": "AVIF", b"heic": "HEIC", b"heix": "HEIC"}
"""Brands of still images, and their format; hevc, hevx and avis are sequences."""

_ANY_STILL = (b"mif1", b"miaf")  # then the compatible brands tell


def still_format(start: bytes) -> str | None:
    """Tell AVIF from HEIC by the brands in a file's first 32 bytes; None for any other file."""
    if start[4:8] != b"ftyp":
        return None
    compatible = (
        start[at : at + 4] for at in range(16, min(int.from_bytes(start[:4]), len(start)), 4)
    )
    brands = compatible if start[8:12] in _ANY_STILL else (start[8:12],)
    return next((_STILL[brand] for brand in brands if brand in _STILL), None)


class Box(NamedTuple):
    """Part of a file.

    Attributes:
        kind: four letters.
        start: offset of its content.
        end: offset of the byte after it; None for the end of the file.
    """

    kind: bytes
    start: int
    end: int | None


def boxes(read_at: ReadAt, start: int = 0, end: int | None = None) -> Iterator[Box]:
    """Yield the boxes from ``start`` to ``end`` or to the end of the file.

    Raises:
        ImageDecodeError: a box has an impossible length.
        ImageTooLargeError: there are more boxes than a photograph needs.
    """
    for _ in range(_MAX_BOXES):
        head = read_at(start, 16)
        if len(head) < 8 or (end is not None and start + 8 > end):
            return
        length, kind = struct.unpack(">I4s", head[:8])
        body = start + 8
        if length == 1:
            (length,) = struct.unpack(">Q", head[8:16])
            body = start + 16
        after = start + length if length else end
        if after is not None and (after < body or (end is not None and after > end)):
            raise ImageDecodeError(f"the image's box {kind!r} has an impossible length: damaged")
        yield Box(kind, body, after)
        if after is None:
            return
        start = after
    raise ImageTooLargeError(f"the image has more than {_MAX_BOXES} boxes; save it again")
