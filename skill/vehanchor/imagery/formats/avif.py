"""Header of an AVIF: its boxes, and the sequence headers of the AV1 images in them.

Both declare sizes: the container's is displayed, AV1's is allocated by the decoder. The limits
apply to the larger, so a small container cannot hide a huge image.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.errors import ImageDecodeError, ImageTooLargeError
from vehanchor.imagery.formats.boxes import still_format
from vehanchor.imagery.formats.heif import (
    Bits,
    ItemLimits,
    item_pieces,
    largest_size,
    metadata_in,
    property_values,
    read_image_properties,
    read_meta,
)
from vehanchor.imagery.formats.image_format import ImageFormat
from vehanchor.imagery.formats.image_header import ImageHeader

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vehanchor.imagery.formats.boxes import Box
    from vehanchor.imagery.formats.ifd import ReadAt

_LIMITS = ItemLimits(items=300, pieces=1, list_bytes=1 << 14)
"""Limits on the items: a grid has at most 256, plus EXIF, XMP and alpha.

300 items take up to 46 bytes each in their list.
"""

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
    parts = read_meta(read_at, "AVIF")
    properties = _read_properties(read_at, parts[b"iprp"])
    decoded_px = properties.width_px * properties.height_px
    complete = True
    metadata = []
    spans = _item_spans(read_at, parts[b"iloc"], parts.get(b"idat"))
    for start, end in spans:
        has_last_byte = len(read_at(end - 1, 1)) == 1
        complete = complete and has_last_byte
        metadata += metadata_in(read_at, start, end - start)
        decoded_px = max(decoded_px, _largest_frame_px(read_at, start, end))
    pixel_bytes = _DECODING_BYTES[properties.has_high_depth, properties.has_alpha]
    return ImageHeader(
        "AVIF",
        properties.width_px,
        properties.height_px,
        orientation=properties.orientation,
        complete=complete,
        decoding_bytes=pixel_bytes * decoded_px,
        metadata=tuple(metadata),
    )


def _read_properties(read_at: ReadAt, iprp: Box) -> _Properties:
    """Read the properties of all images together.

    Raises:
        ImageDecodeError: there is no size, or there are several rotations.
        struct.error: the file ends within a property.
    """
    properties = read_image_properties(read_at, iprp)
    size = largest_size(read_at, properties)
    turns = property_values(read_at, properties, b"irot", values_format="B")
    mirrors = property_values(read_at, properties, b"imir", values_format="B")
    if size is None or len(turns) > 1 or len(mirrors) > 1:
        raise ImageDecodeError(
            "the AVIF declares no size or several rotations: damaged, or not a photograph; save it "
            "again"
        )
    width, height = size
    quarter_turns = next((turn & 3 for (turn,) in turns), 0)
    mirror_axis = next((axis & 1 for (axis,) in mirrors), None)
    configurations = property_values(read_at, properties, b"av1C", values_format="3B")
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
    for piece in item_pieces(read_at, iloc, idat, name="AVIF", limits=_LIMITS):
        if not piece.in_file:
            raise ImageDecodeError(
                "the AVIF stores an image within another, or nowhere; save it again"
            )
        if piece.length == 0:
            raise ImageDecodeError(
                "the AVIF does not declare the length of an image; save it again"
            )
        yield piece.start, piece.start + piece.length


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
            width, height = _sequence_size(Bits(header))
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


def _sequence_size(read_bits: Bits) -> tuple[int, int]:
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


def _skip_timing(read_bits: Bits) -> int:
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


def _is_avif(start: bytes) -> bool:
    return still_format(start) == "AVIF"


AVIF = ImageFormat(
    name="AVIF",
    suffixes=(".avif",),
    recognises=_is_avif,
    read_header=read_avif,
    has_alpha=True,
)
