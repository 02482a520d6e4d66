"""Header of an AVIF: its boxes, and the sequence headers of the AV1 images in them.

Both declare sizes: the container's is displayed, AV1's is allocated by the decoder. The limits
apply to the larger, so a small container cannot hide a huge image.
"""

from __future__ import annotations

import math
import struct
from itertools import islice
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.errors import ImageDecodeError, ImageTooLargeError
from vehanchor.imagery.formats.boxes import boxes
from vehanchor.imagery.formats.image_header import ImageHeader

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vehanchor.imagery.formats.boxes import Box
    from vehanchor.imagery.formats.ifd import ReadAt

_MAX_META_BYTES = 1 << 20
_MAX_ITEMS = 300
"""Maximum number of items; a grid has at most 256, plus EXIF, XMP and alpha."""

_MAX_ILOC_BYTES = 1 << 14
"""Bytes of the list of items to read: 300 items take up to 46 bytes each."""

_MAX_OBUS = 100
"""Maximum number of units (OBU) in an item, which is one image."""

_MAX_SEQUENCE_HEADER_BYTES = 512
_OBU_SEQUENCE_HEADER = 1
_HIGH_BIT_DEPTH = 0x40
"""Bit of the third byte of "av1C" that is set for more than 8 bits."""

_DECODING_BYTES = {(False, False): 19, (False, True): 34, (True, False): 25, (True, True): 44}
"""Bytes per pixel by (more than 8 bits, alpha), measured in tests/bombs.py."""

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
"""EXIF orientation by quarter turns anticlockwise, and mirror: None, 0 up-down, 1 left-right.

The turn comes before the mirror.
"""


class _Properties(NamedTuple):
    """Properties of the images in an AVIF.

    Attributes:
        width_px: width of the largest image, before it is turned.
        height_px: height of the largest image.
        orientation: EXIF orientation.
        has_high_depth: whether an image has more than 8 bits.
        has_alpha: whether an image is auxiliary: alpha, or a depth map.
    """

    width_px: int
    height_px: int
    orientation: int
    has_high_depth: bool
    has_alpha: bool


def read_avif(read_at: ReadAt) -> ImageHeader:
    """Read the header of an AVIF.

    The size is that of its largest image. The memory for decoding follows from the larger of the
    size in the container and the size in AV1's sequence headers.

    Raises:
        ImageDecodeError: the file is damaged or an animation.
        ImageTooLargeError: the file has more parts than a photograph needs.
        struct.error: the file ends within its header.
    """
    parts = _read_meta(read_at)
    properties = _read_properties(read_at, parts[b"iprp"])
    decoded_px = properties.width_px * properties.height_px
    complete = True
    spans = _item_spans(read_at, parts[b"iloc"], parts.get(b"idat"))
    for start, end in spans:
        has_last_byte = len(read_at(end - 1, 1)) == 1
        complete = complete and has_last_byte
        decoded_px = max(decoded_px, _largest_frame_px(read_at, start, end))
    pixel_bytes = _DECODING_BYTES[properties.has_high_depth, properties.has_alpha]
    return ImageHeader(
        "AVIF",
        properties.width_px,
        properties.height_px,
        orientation=properties.orientation,
        complete=complete,
        decoding_bytes=pixel_bytes * decoded_px,
    )


def _read_meta(read_at: ReadAt) -> dict[bytes, Box]:
    """Find the parts of the "meta" box by their kinds; "iprp" and "iloc" are among them.

    Raises:
        ImageDecodeError: the box or one of the two parts is missing, or the file is an animation.
        ImageTooLargeError: the box is larger than a photograph needs.
    """
    candidates = (box for box in boxes(read_at) if box.kind in (b"meta", b"moov"))
    meta = next(candidates, None)
    if meta is None or meta.end is None:
        raise ImageDecodeError("the AVIF has no 'meta' box: truncated or damaged")
    if meta.kind == b"moov":
        raise ImageDecodeError("the AVIF is an animation; save one frame as PNG and send that")
    if meta.end - meta.start > _MAX_META_BYTES:
        raise ImageTooLargeError(
            f"the AVIF's header is larger than {_MAX_META_BYTES} bytes; save it again"
        )
    # Version and flags, 4 bytes, precede the boxes.
    parts = {box.kind: box for box in boxes(read_at, meta.start + 4, meta.end)}
    if b"iprp" not in parts or b"iloc" not in parts:
        raise ImageDecodeError("the AVIF does not declare where its images are: damaged")
    return parts


def _read_properties(read_at: ReadAt, iprp: Box) -> _Properties:
    """Read the properties of all images together.

    Raises:
        ImageDecodeError: there is no size, or there are several rotations.
        struct.error: the file ends within a property.
    """
    properties: list[Box] = []
    for container in boxes(read_at, iprp.start, iprp.end):
        if container.kind == b"ipco":
            properties.extend(boxes(read_at, container.start, container.end))

    def read_values(kind: bytes, values_format: str, skip: int = 0) -> set[tuple[int, ...]]:
        """Read the distinct values of a kind of property, after ``skip`` bytes."""
        n_bytes = struct.calcsize(values_format)
        starts = [box.start + skip for box in properties if box.kind == kind]
        return {struct.unpack(values_format, read_at(start, n_bytes)) for start in starts}

    sizes = read_values(b"ispe", ">II", skip=4)
    turns = read_values(b"irot", "B")
    mirrors = read_values(b"imir", "B")
    if not sizes or len(turns) > 1 or len(mirrors) > 1:
        raise ImageDecodeError(
            "the AVIF declares no size or several rotations: damaged, or not a photograph; save it "
            "again"
        )
    width, height = max(sizes, key=math.prod)
    quarter_turns = 0
    for (turn,) in turns:
        quarter_turns = turn & 3
    mirror_axis = None
    for (axis,) in mirrors:
        mirror_axis = axis & 1
    configurations = read_values(b"av1C", "3B")
    third_bytes = [third for _, _, third in configurations]
    return _Properties(
        width,
        height,
        orientation=_EXIF_ORIENTATION[quarter_turns, mirror_axis],
        has_high_depth=any(third & _HIGH_BIT_DEPTH for third in third_bytes),
        has_alpha=any(box.kind == b"auxC" for box in properties),
    )


def _item_spans(read_at: ReadAt, iloc: Box, idat: Box | None) -> Iterator[tuple[int, int]]:
    """Yield start and end of each item: images, and metadata, which hold no sequence header.

    Raises:
        ImageDecodeError: an item is in several pieces, within another, or of unknown length.
        ImageTooLargeError: there are too many items.
        struct.error: the file ends within the list of items.
    """
    read_bits = _Bits(read_at(iloc.start, _MAX_ILOC_BYTES))
    version = read_bits(8)
    read_bits(24)  # flags
    offset_bits = 8 * read_bits(4)
    length_bits = 8 * read_bits(4)
    base_bits = 8 * read_bits(4)
    index_bits = 8 * read_bits(4)
    number_bits = 32 if version == 2 else 16
    n_items = read_bits(number_bits)
    if n_items > _MAX_ITEMS:
        raise ImageTooLargeError(f"the AVIF has more than {_MAX_ITEMS} parts; save it again")
    for _ in range(n_items):
        read_bits(number_bits)  # number of the item
        is_in_idat = False
        if version:
            construction_method = read_bits(16) & 15
            is_in_idat = construction_method == 1
            if construction_method > 1 or (is_in_idat and idat is None):
                raise ImageDecodeError(
                    "the AVIF stores an image within another, or nowhere; save it again"
                )
        read_bits(16)  # number of the file that holds the data
        start = read_bits(base_bits)
        n_pieces = read_bits(16)
        if n_pieces > 1:
            raise ImageDecodeError("the AVIF stores an image in several pieces; save it again")
        if n_pieces == 0:
            continue
        if version:
            read_bits(index_bits)
        start += read_bits(offset_bits)
        if is_in_idat and idat is not None:
            start += idat.start
        length = read_bits(length_bits)
        if length == 0:
            raise ImageDecodeError(
                "the AVIF does not declare the length of an image; save it again"
            )
        yield start, start + length


def _largest_frame_px(read_at: ReadAt, position: int, end: int) -> int:
    """Compute the pixels of the largest frame that the sequence headers of an image allow.

    Units (OBU) follow each other; AV1 specification, section 5.3.

    Raises:
        ImageTooLargeError: there are too many units.
        struct.error: the file ends within a sequence header.
    """
    largest_px = 0
    for _ in range(_MAX_OBUS):
        head = read_at(position, 1)
        if position >= end or not head:
            return largest_px
        kind = head[0] >> 3 & 15
        has_extension = head[0] & 4
        has_length = head[0] & 2
        position += 2 if has_extension else 1
        length = end - position
        if has_length:
            length, n_bytes = _leb128(read_at(position, 8))
            position += n_bytes
        if kind == _OBU_SEQUENCE_HEADER:
            header = read_at(position, min(length, _MAX_SEQUENCE_HEADER_BYTES))
            width, height = _sequence_size(_Bits(header))
            largest_px = max(largest_px, width * height)
        position += length
    raise ImageTooLargeError(f"the AVIF has an image of more than {_MAX_OBUS} parts; save it again")


def _leb128(data: bytes) -> tuple[int, int]:
    """Read a number of variable length, 7 bits a byte; return it and the number of its bytes.

    Raises:
        struct.error: the data end within the number.
    """
    value = 0
    for i, byte in enumerate(data):
        value |= (byte & 127) << 7 * i
        is_last = not byte & 128
        if is_last:
            return value, i + 1
    raise struct.error


class _Bits:
    """Reader of numbers of any width in bits; a call reads the next one."""

    def __init__(self, data: bytes) -> None:
        self._digits = iter("".join(f"{byte:08b}" for byte in data))

    def __call__(self, n: int) -> int:
        digits = "".join(islice(self._digits, n))
        if len(digits) < n:
            raise struct.error
        return int(digits or "0", 2)


def _sequence_size(read_bits: _Bits) -> tuple[int, int]:
    """Read the largest frame size of a sequence (AV1 specification, section 5.5.1)."""
    read_bits(4)  # profile, still picture
    has_reduced_header = read_bits(1)
    if has_reduced_header:
        read_bits(5)  # level
    else:
        delay_bits = _skip_timing(read_bits)
        has_display_delay = read_bits(1)
        n_operating_points = read_bits(5) + 1
        for _ in range(n_operating_points):
            read_bits(12)  # layers
            level = read_bits(5)
            if level > 7:
                read_bits(1)  # tier
            if delay_bits and read_bits(1):
                read_bits(2 * delay_bits + 1)
            if has_display_delay and read_bits(1):
                read_bits(4)
    width_bits = read_bits(4) + 1
    height_bits = read_bits(4) + 1
    width = read_bits(width_bits) + 1
    height = read_bits(height_bits) + 1
    return width, height


def _skip_timing(read_bits: _Bits) -> int:
    """Skip the timing information; return the width of the decoder delay in bits, 0 without one."""
    has_timing = read_bits(1)
    if not has_timing:
        return 0
    read_bits(64)  # units of the display tick, time scale
    has_equal_intervals = read_bits(1)
    if has_equal_intervals:
        # A number follows as many zeros as it has bits.
        n_zeros = 0
        while not read_bits(1):
            n_zeros += 1
        read_bits(n_zeros if n_zeros < 32 else 0)
    has_decoder_model = read_bits(1)
    if not has_decoder_model:
        return 0
    delay_bits = read_bits(5) + 1
    read_bits(42)
    return delay_bits
