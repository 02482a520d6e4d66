"""Header of an AVIF: its boxes, and the sequence headers of the AV1 images in them.

Both declare sizes: the container's is displayed, AV1's is allocated by the decoder. The limits
apply to the larger, so a small container cannot hide a huge image.
"""

from __future__ import annotations

import math
import struct
from itertools import islice
from typing import TYPE_CHECKING

from vehanchor.errors import ImageDecodeError, ImageTooLargeError
from vehanchor.imagery.formats.boxes import boxes
from vehanchor.imagery.formats.image_header import ImageHeader

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vehanchor.imagery.formats.boxes import Box
    from vehanchor.imagery.formats.ifd import ReadAt

_MAX_META_BYTES = 1 << 20
_MAX_ITEMS = 300  # a grid has at most 256, plus EXIF, XMP and alpha
_MAX_ILOC_BYTES = 1 << 14  # of 300 items of up to 46 bytes
_MAX_OBUS = 100  # of one item, which is one image
_OBU_SEQUENCE_HEADER = 1
_HIGH_BIT_DEPTH = 0x40  # bit of the third byte of "av1C"
_DECODING_BYTES = {(False, False): 19, (False, True): 34, (True, False): 25, (True, True): 44}
"""Bytes per pixel by (more than 8 bits, alpha), measured in tests/bombs.py."""

# (quarter turns anticlockwise, mirror: None, 0 up-down, 1 left-right); the turn comes first
_EXIF_ORIENTATION = {
    (0, None): 1,
    (0, 1): 2,
    (2, None): 3,
    (0, 0): 4,
    (1, 0): 5,
    (3, None): 6,
    (1, 1): 7,
    (1, None): 8,
    (2, 0): 2,
    (2, 1): 4,
    (3, 0): 7,
    (3, 1): 5,
}


def read_avif(read_at: ReadAt) -> ImageHeader:
    """Read the header of an AVIF: the size of its largest image, and the larger of both sizes to decode.

    Raises:
        ImageDecodeError: the file is damaged or an animation.
        ImageTooLargeError: the file has more parts than a photograph needs.
        struct.error: the file ends within its header.
    """
    meta = next((box for box in boxes(read_at) if box.kind in (b"meta", b"moov")), None)
    if meta is None or meta.end is None:
        raise ImageDecodeError("the AVIF has no 'meta' box: truncated or damaged")
    if meta.kind == b"moov":
        raise ImageDecodeError("the AVIF is an animation; save one frame as PNG and send that")
    if meta.end - meta.start > _MAX_META_BYTES:
        raise ImageTooLargeError(
            f"the AVIF's header is larger than {_MAX_META_BYTES} bytes; save it again"
        )
    parts = {box.kind: box for box in boxes(read_at, meta.start + 4, meta.end)}
    if not {b"iprp", b"iloc"} <= set(parts):
        raise ImageDecodeError("the AVIF does not declare where its images are: damaged")
    containers = [box for box in boxes(read_at, *parts[b"iprp"][1:]) if box.kind == b"ipco"]
    properties = [box for each in containers for box in boxes(read_at, each.start, each.end)]

    def values(kind: bytes, form: str, at: int = 0) -> set[tuple[int, ...]]:
        found = (
            read_at(box.start + at, struct.calcsize(form)) for box in properties if box.kind == kind
        )
        return {struct.unpack(form, each) for each in found}

    sizes = values(b"ispe", ">II", 4)
    turns = values(b"irot", "B")
    mirrors = values(b"imir", "B")
    if not sizes or len(turns) > 1 or len(mirrors) > 1:
        raise ImageDecodeError(
            "the AVIF declares no size or several rotations: damaged or no photo; save it again"
        )
    width, height = max(sizes, key=math.prod)
    turned = _EXIF_ORIENTATION[
        next((turn & 3 for (turn,) in turns), 0), next((axis & 1 for (axis,) in mirrors), None)
    ]
    deep = any(third & _HIGH_BIT_DEPTH for _, _, third in values(b"av1C", "3B"))
    # of another image, which is alpha or a depth map
    alpha = any(box.kind == b"auxC" for box in properties)
    decoded_px = width * height
    complete = True
    for start, end in _items(read_at, parts):
        complete = complete and len(read_at(end - 1, 1)) == 1
        decoded_px = max(decoded_px, _largest_frame_px(read_at, start, end))
    decoding_bytes = _DECODING_BYTES[deep, alpha] * decoded_px
    return ImageHeader(
        "AVIF", width, height, orientation=turned, complete=complete, decoding_bytes=decoding_bytes
    )


def _items(read_at: ReadAt, parts: dict[bytes, Box]) -> Iterator[tuple[int, int]]:
    """Yield the start and end of each item: images, and metadata, which hold no sequence header."""
    iloc = parts[b"iloc"]
    idat = parts.get(b"idat")
    bits = _Bits(read_at(iloc.start, _MAX_ILOC_BYTES))
    version = bits(8)
    _ = bits(24)
    offset_bits, length_bits, base_bits, index_bits = (8 * bits(4) for _ in range(4))
    wide = 32 if version == 2 else 16
    n_items = bits(wide)
    if n_items > _MAX_ITEMS:
        raise ImageTooLargeError(f"the AVIF has more than {_MAX_ITEMS} parts; save it again")
    for _ in range(n_items):
        bits(wide)  # number of the item
        method = bits(16) & 15 if version else 0
        if method > 1 or (method == 1 and idat is None):
            raise ImageDecodeError(
                "the AVIF stores an image within another, or nowhere; save it again"
            )
        bits(16)
        start = bits(base_bits)
        n_pieces = bits(16)
        if n_pieces > 1:
            raise ImageDecodeError("the AVIF stores an image in several pieces; save it again")
        if n_pieces:
            bits(index_bits if version else 0)
            start += bits(offset_bits) + (idat.start if method == 1 and idat is not None else 0)
            length = bits(length_bits)
            if length == 0:
                raise ImageDecodeError(
                    "the AVIF does not declare the length of an image; save it again"
                )
            yield start, start + length


def _largest_frame_px(read_at: ReadAt, position: int, end: int) -> int:
    """Compute the pixels of the largest frame that the sequence headers of an image allow."""
    largest = 0
    for _ in range(_MAX_OBUS):
        head = read_at(position, 10)
        if position >= end or not head:
            return largest
        kind = head[0] >> 3 & 15
        has_length = head[0] & 2
        position += 2 if head[0] & 4 else 1
        length = end - position
        if has_length:
            length, n_bytes = _leb128(read_at(position, 8))
            position += n_bytes
        if kind == _OBU_SEQUENCE_HEADER:
            width, height = _sequence_size(_Bits(read_at(position, min(length, 512))))
            largest = max(largest, width * height)
        position += length
    raise ImageTooLargeError(f"the AVIF has an image of more than {_MAX_OBUS} parts; save it again")


def _leb128(data: bytes) -> tuple[int, int]:
    value = 0
    for i, byte in enumerate(data):
        value |= (byte & 127) << 7 * i
        if not byte & 128:
            return value, i + 1
    raise struct.error


class _Bits:
    """Reader of numbers of any width in bits."""

    def __init__(self, data: bytes) -> None:
        self._digits = iter("".join(f"{byte:08b}" for byte in data))

    def __call__(self, n: int) -> int:
        digits = "".join(islice(self._digits, n))
        if len(digits) < n:
            raise struct.error
        return int(digits or "0", 2)


def _sequence_size(bits: _Bits) -> tuple[int, int]:
    """Read the largest frame size of a sequence (AV1 specification, section 5.5.1)."""
    bits(4)  # profile, still picture
    if bits(1):  # reduced header
        bits(5)
    else:
        delay_bits = _timing(bits)
        shows_delay = bits(1)
        for _ in range(bits(5) + 1):  # operating points
            bits(12)
            if bits(5) > 7:
                bits(1)
            if delay_bits and bits(1):
                bits(2 * delay_bits + 1)
            if shows_delay and bits(1):
                bits(4)
    width_bits = bits(4) + 1
    height_bits = bits(4) + 1
    return bits(width_bits) + 1, bits(height_bits) + 1


def _timing(bits: _Bits) -> int:
    """Skip the timing information; return the width of the decoder delay in bits, 0 without one."""
    if not bits(1):
        return 0
    bits(64)
    if bits(1):  # equal intervals: a number after as many zeros as it has bits
        zeros = 0
        while not bits(1):
            zeros += 1
        bits(zeros if zeros < 32 else 0)
    if not bits(1):
        return 0
    delay_bits = bits(5) + 1
    bits(42)
    return delay_bits
