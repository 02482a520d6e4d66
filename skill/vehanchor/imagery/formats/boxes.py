"""Boxes of ISO base media files: AVIF, HEIC and JPEG 2000."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.errors import ImageDecodeError, ImageTooLargeError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vehanchor.imagery.formats.ifd import ReadAt

_MAX_BOXES = 1000
"""Maximum number of boxes in one box; real files have a dozen."""

_MAX_DEPTH = 8
"""Maximum depth of boxes within boxes; real files have three."""

_STILL_FORMATS = {b"avif": "AVIF", b"heic": "HEIC", b"heix": "HEIC"}
"""Formats of still images by brand; the brands hevc, hevx and avis are sequences."""

_UNSPECIFIC_BRANDS = (b"mif1", b"miaf")
"""Brands of any still image, for which the compatible brands decide."""


def still_format(start: bytes) -> str | None:
    """Distinguish AVIF and HEIC by the brands in a file's first 32 bytes; None for other files."""
    if start[4:8] != b"ftyp":
        return None
    major_brand = start[8:12]
    if major_brand not in _UNSPECIFIC_BRANDS:
        return _STILL_FORMATS.get(major_brand)
    box_bytes = int.from_bytes(start[:4])
    for offset in range(16, min(box_bytes, len(start)), 4):
        compatible_brand = start[offset : offset + 4]
        if compatible_brand in _STILL_FORMATS:
            return _STILL_FORMATS[compatible_brand]
    return None


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
        content = start + 8
        if length == 1:  # a 64-bit length follows
            (length,) = struct.unpack(">Q", head[8:16])
            content = start + 16
        box_end = start + length if length else end
        if box_end is None:
            yield Box(kind, content, None)
            return
        ends_outside = end is not None and box_end > end
        if box_end < content or ends_outside:
            raise ImageDecodeError(f"the image's box {kind!r} has an impossible length: damaged")
        yield Box(kind, content, box_end)
        start = box_end
    raise ImageTooLargeError(f"the image has more than {_MAX_BOXES} boxes; save it again")


def check_nested_boxes(
    read_at: ReadAt, parent: Box, superboxes: frozenset[bytes], depth: int = 1
) -> None:
    """Check the lengths of all boxes within a box; only the last box of a file may lack one.

    Args:
        read_at: reads bytes of the file.
        parent: the box.
        superboxes: kinds of boxes that contain boxes.
        depth: number of boxes around its content.

    Raises:
        ImageDecodeError: a box has an impossible length, or none.
        ImageTooLargeError: there are more boxes than a photograph needs.
    """
    if depth > _MAX_DEPTH:
        raise ImageTooLargeError(
            f"the image has more than {_MAX_DEPTH} boxes within each other; save it again"
        )
    for box in boxes(read_at, parent.start, parent.end):
        has_length = read_at(box.start - 8, 4) != bytes(4)
        if not has_length:
            raise ImageDecodeError(f"the image's box {box.kind!r} has no length: damaged")
        if box.kind in superboxes:
            check_nested_boxes(read_at, box, superboxes, depth + 1)
