"""Header of an AVIF: its boxes, and the sequence headers of the AV1 images in them.

Both declare sizes: the container's is displayed, AV1's is allocated by the decoder. The limits apply to the larger, so
a small container cannot hide a huge image.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.errors import ImageDecodeError, ImageTooLargeError
from vehanchor.imagery.formats.image_header import ImageHeader

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vehanchor.imagery.formats.ifd import ReadAt

_BRANDS = frozenset({b"avif", b"mif1", b"miaf"})
_MAX_BOXES = 1000  # in one box; real files have a dozen
_MAX_META_BYTES = 1 << 20
_MAX_ITEMS = 300  # a grid has at most 256, plus EXIF, XMP and alpha
_MAX_OBUS = 100  # of one item, which is one image
_OBU_SEQUENCE_HEADER = 1
_HIGH_BIT_DEPTH = 0x40  # bit of the third byte of "av1C"
_DECODING_BYTES = {(False, False): 19, (False, True): 34, (True, False): 25, (True, True): 44}
"""Bytes per pixel by (more than 8 bits, alpha), measured in tests/bombs.py."""

_EXIF_ORIENTATION = {  # (quarter turns anticlockwise, mirror: None, 0 up-down, 1 left-right); the turn comes first
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


class _Box(NamedTuple):
    kind: bytes
    start: int
    """Offset of its content."""
    end: int


def is_avif(start: bytes) -> bool:
    """Test whether a file that begins with these 32 bytes is a still AVIF."""
    (length,) = struct.unpack(">I", start[:4]) if len(start) >= 16 else (0,)
    if start[4:8] != b"ftyp" or start[8:12] not in _BRANDS:
        return False
    compatible = start[16 : min(length, len(start))]
    return start[8:12] == b"avif" or b"avif" in (compatible[at : at + 4] for at in range(0, len(compatible), 4))


def read_avif(read_at: ReadAt) -> ImageHeader:
    """Read the header of an AVIF: the size of its largest image, and the larger of both sizes to decode.

    Raises:
        ImageDecodeError: the file is damaged or an animation.
        ImageTooLargeError: the file has more parts than a photograph needs.
        struct.error: the file ends within its header.
    """
    top = {box.kind: box for box in _boxes(read_at, 0, None, until=b"meta")}
    if b"moov" in top:
        raise ImageDecodeError("the AVIF is an animation; save one frame as PNG and send that")
    if b"meta" not in top:
        raise ImageDecodeError("the AVIF has no 'meta' box: truncated or damaged")
    meta = top[b"meta"]
    if meta.end - meta.start > _MAX_META_BYTES:
        raise ImageTooLargeError(f"the AVIF's header is larger than {_MAX_META_BYTES} bytes; save it again")
    parts = {box.kind: box for box in _boxes(read_at, meta.start + 4, meta.end)}
    if not {b"iprp", b"iloc", b"iinf"} <= set(parts):
        raise ImageDecodeError("the AVIF does not declare where its images are: damaged")
    sizes, turns, mirrors, deep, alpha = _properties(read_at, parts[b"iprp"])
    if not sizes or len(turns) > 1 or len(mirrors) > 1:
        raise ImageDecodeError("the AVIF declares no size or several rotations: damaged or no photo; save it again")
    width, height = max(sizes, key=lambda size: size[0] * size[1])
    turned = _EXIF_ORIENTATION[min(turns, default=0), min(mirrors, default=None)]
    decoded_px, complete = width * height, True
    for position, length in _images(read_at, parts):
        complete = complete and len(read_at(position + length - 1, 1)) == 1
        decoded_px = max(decoded_px, _largest_frame_px(read_at, position, position + length))
    decoding_bytes = _DECODING_BYTES[deep, alpha] * decoded_px
    return ImageHeader("AVIF", width, height, orientation=turned, complete=complete, decoding_bytes=decoding_bytes)


def _boxes(read_at: ReadAt, start: int, end: int | None, until: bytes | None = None) -> Iterator[_Box]:
    """Yield the boxes from ``start`` to ``end``, to the end of the file, or to the first box of kind ``until``."""
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
        if after is None or after < body or (end is not None and after > end):
            raise ImageDecodeError(f"the AVIF's box {kind!r} has an impossible length: damaged")
        yield _Box(kind, body, after)
        if kind == until:
            return
        start = after
    raise ImageTooLargeError(f"the AVIF has more than {_MAX_BOXES} boxes; save it again")


def _properties(read_at: ReadAt, iprp: _Box) -> tuple[set[tuple[int, int]], set[int], set[int], bool, bool]:
    """Collect the sizes, quarter turns and mirrors of all images; whether one has more than 8 bits, or alpha."""
    sizes, turns, mirrors, deep, alpha = set(), set(), set(), False, False
    for container in _boxes(read_at, iprp.start, iprp.end):
        if container.kind != b"ipco":
            continue
        for box in _boxes(read_at, container.start, container.end):
            if box.kind == b"ispe":
                width, height = struct.unpack(">II", read_at(box.start + 4, 8))
                sizes.add((width, height))
            elif box.kind == b"irot":
                turns.add(_byte(read_at, box.start) & 3)
            elif box.kind == b"imir":
                mirrors.add(_byte(read_at, box.start) & 1)
            elif box.kind == b"auxC":  # of another image, which is alpha or a depth map
                alpha = True
            elif box.kind == b"av1C":
                deep = deep or bool(_byte(read_at, box.start + 2) & _HIGH_BIT_DEPTH)
    return sizes, turns, mirrors, deep, alpha


def _images(read_at: ReadAt, parts: dict[bytes, _Box]) -> Iterator[tuple[int, int]]:
    """Yield the offset and length of each AV1 image."""
    iinf = parts[b"iinf"]
    version = _byte(read_at, iinf.start)
    kinds = {}
    for box in _boxes(read_at, iinf.start + (6 if version == 0 else 8), iinf.end):
        form = ">I2x4s" if _byte(read_at, box.start) == 3 else ">H2x4s"
        item, kind = struct.unpack(form, read_at(box.start + 4, struct.calcsize(form)))
        kinds[item] = kind
    idat = parts.get(b"idat")
    for item, by_idat, extents in _locations(read_at, parts[b"iloc"]):
        if kinds.get(item) != b"av01":
            continue
        if len(extents) != 1:
            raise ImageDecodeError("the AVIF stores an image in several pieces; save it again")
        ((offset, length),) = extents
        if by_idat and idat is None:
            raise ImageDecodeError("the AVIF refers to image data that is missing: damaged")
        start = offset + (idat.start if by_idat and idat is not None else 0)
        if length == 0:
            raise ImageDecodeError("the AVIF does not declare the length of an image; save it again")
        yield start, length


def _locations(read_at: ReadAt, iloc: _Box) -> Iterator[tuple[int, bool, list[tuple[int, int]]]]:
    """Yield each item's number, whether it lies in ``idat``, and its (offset, length) pieces."""
    data = read_at(iloc.start, iloc.end - iloc.start)
    if len(data) < 6:
        raise struct.error
    version = data[0]
    widths = data[4] >> 4, data[4] & 15, data[5] >> 4, (data[5] & 15) if version else 0
    position = 6

    def number(n_bytes: int) -> int:
        nonlocal position
        if position + n_bytes > len(data):
            raise struct.error
        position += n_bytes
        return int.from_bytes(data[position - n_bytes : position], "big")

    wide = 4 if version == 2 else 2
    offset_bytes, length_bytes, base_bytes, index_bytes = widths
    n_items = number(wide)
    if n_items > _MAX_ITEMS:
        raise ImageTooLargeError(f"the AVIF has more than {_MAX_ITEMS} parts; save it again")
    for _ in range(n_items):
        item = number(wide)
        method = number(2) & 15 if version else 0
        if method > 1:
            raise ImageDecodeError("the AVIF stores an image within another; save it again")
        number(2)
        base = number(base_bytes)
        extents = []
        for _ in range(number(2)):
            number(index_bytes)
            offset = base + number(offset_bytes)
            extents.append((offset, number(length_bytes)))
        yield item, method == 1, extents


def _largest_frame_px(read_at: ReadAt, position: int, end: int) -> int:
    """Compute the pixels of the largest frame that the sequence headers of an image allow."""
    largest = 0
    for _ in range(_MAX_OBUS):
        if position >= end:
            return largest
        head = read_at(position, 10)
        if not head:
            return largest
        kind, has_length = head[0] >> 3 & 15, head[0] & 2
        position += 2 if head[0] & 4 else 1
        length = end - position
        if has_length:
            length, n_bytes = _leb128(read_at(position, 8))
            position += n_bytes
        if kind == _OBU_SEQUENCE_HEADER:
            width, height = _sequence_size(read_at(position, min(length, 512)))
            largest = max(largest, width * height)
        position += length
    raise ImageTooLargeError(f"the AVIF has an image of more than {_MAX_OBUS} parts; save it again")


def _byte(read_at: ReadAt, position: int) -> int:
    (value,) = struct.unpack("B", read_at(position, 1))
    return int(value)


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
        self._value = int.from_bytes(data, "big")
        self._left = 8 * len(data)

    def __call__(self, n: int) -> int:
        self._left -= n
        if self._left < 0:
            raise struct.error
        return self._value >> self._left & ((1 << n) - 1)


def _sequence_size(data: bytes) -> tuple[int, int]:
    """Read the largest frame size of a sequence (AV1 specification, section 5.5.1)."""
    bits = _Bits(data)
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
    width_bits, height_bits = bits(4) + 1, bits(4) + 1
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
