"""Still images in the HEIF container (ISO/IEC 23008-12): the parts that AVIF and HEIC share.

The container declares the sizes of its images, and where their data lie. The codec's own data
declare sizes, too; those of AV1 are read in ``avif``, those of HEVC by libheif alone.
"""

from __future__ import annotations

import math
import struct
from contextlib import suppress
from itertools import islice
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.errors import ImageDecodeError, ImageTooLargeError
from vehanchor.imagery.formats.boxes import boxes, still_format
from vehanchor.imagery.formats.heif_items import Piece, check_items
from vehanchor.imagery.formats.ifd import TIFF_SIGNATURES
from vehanchor.imagery.formats.image_format import DecoderExtra, ImageFormat
from vehanchor.imagery.formats.image_header import ImageHeader

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vehanchor.imagery.formats.boxes import Box
    from vehanchor.imagery.formats.ifd import ReadAt

_MAX_META_BYTES = 1 << 20

HEIC_PIXEL_BYTES = 12
"""Memory for decoding a HEIC: two 16-bit planes of HEVC's colours, and RGB with alpha twice."""


_UNIQUE_PARTS = frozenset((b"iprp", b"iloc", b"iinf", b"pitm", b"iref", b"idat"))
"""Parts of the "meta" box that occur once (ISO/IEC 14496-12)."""


class ItemLimits(NamedTuple):
    """Limits on the items of a file: images, their tiles, and metadata.

    Attributes:
        items: maximum number of items.
        pieces: maximum number of pieces of one item.
        list_bytes: bytes of the list of items to read.
    """

    items: int
    pieces: int
    list_bytes: int


_HEIC_LIMITS = ItemLimits(items=1000, pieces=32, list_bytes=1 << 16)
"""Limits of libheif itself, and the bytes of a list of 1,000 items that have one piece each."""

_EXIF_HEAD_BYTES = 64
"""Bytes of an item in which EXIF begins."""

_IN_FILE = 0
_IN_IDAT = 1
"""Construction methods: where the pieces of an item lie. The third is within another item."""


def read_heic(read_at: ReadAt) -> ImageHeader:
    """Read the header of a HEIC without libheif.

    The size is that of the largest image in the container, before libheif crops and turns it. A
    file is complete if it contains the last byte of every item.

    Raises:
        ImageDecodeError: the file is damaged.
        ImageTooLargeError: the file has more parts than a photograph needs.
        struct.error: the file ends within its header.
    """
    parts = read_meta(read_at, "HEIC")
    properties = read_image_properties(read_at, parts[b"iprp"])
    size = largest_size(read_at, properties)
    if size is None:
        raise ImageDecodeError("the HEIC declares no size: damaged, or not a photograph")
    width, height = size
    pieces = list(
        item_pieces(read_at, parts[b"iloc"], parts.get(b"idat"), name="HEIC", limits=_HEIC_LIMITS)
    )
    check_items(read_at, parts, properties, pieces)
    complete = True
    metadata = []
    for piece in pieces:
        if piece.in_file and piece.length > 0:
            last_byte = read_at(piece.start + piece.length - 1, 1)
            complete = complete and len(last_byte) == 1
            metadata += metadata_in(read_at, piece.start, piece.length)
    return ImageHeader(
        "HEIC",
        width,
        height,
        complete=complete,
        decoding_bytes=HEIC_PIXEL_BYTES * width * height,
        metadata=tuple(metadata),
    )


def metadata_in(read_at: ReadAt, start: int, length: int) -> list[tuple[int, int]]:
    """Find EXIF or XMP in a piece of an item; empty for pixels.

    EXIF begins after an offset of four bytes, which counts from its own end (ISO/IEC 23008-12,
    A.2.1).

    Args:
        read_at: reads the file.
        start: offset of the piece.
        length: its bytes.

    Returns:
        Offset and length of the block.
    """
    head = read_at(start, _EXIF_HEAD_BYTES)
    if head.startswith((b"<?xpacket", b"<x:xmpmeta")):
        return [(start, length)]
    first = 4 + int.from_bytes(head[:4])
    if head[first : first + 4] in TIFF_SIGNATURES and length > first:
        return [(start + first, length - first)]
    return []


def read_meta(read_at: ReadAt, name: str) -> dict[bytes, Box]:
    """Find the parts of the "meta" box by their kinds; "iprp" and "iloc" are among them.

    Args:
        read_at: reads the file.
        name: format of the file, for messages.

    Raises:
        ImageDecodeError: the box or one of the two parts is missing, or the file is an animation.
        ImageTooLargeError: the box is larger than a photograph needs.
    """
    meta = _find_meta(read_at, name)
    if meta is None or meta.end is None:
        raise ImageDecodeError(f"the {name} has no 'meta' box: truncated or damaged")
    if meta.kind == b"moov":
        raise ImageDecodeError(f"the {name} is an animation; save one frame as PNG and send that")
    if meta.end - meta.start > _MAX_META_BYTES:
        raise ImageTooLargeError(
            f"the {name}'s header is larger than {_MAX_META_BYTES} bytes; save it again"
        )
    # Version and flags, 4 bytes, precede the boxes.
    parts: dict[bytes, Box] = {}
    for box in boxes(read_at, meta.start + 4, meta.end):
        # One reader takes the first, another the last.
        if box.kind in _UNIQUE_PARTS and box.kind in parts:
            raise ImageDecodeError(f"the {name} has two boxes {box.kind!r}: damaged")
        parts[box.kind] = box
    if b"iprp" not in parts or b"iloc" not in parts:
        raise ImageDecodeError(f"the {name} does not declare where its images are: damaged")
    return parts


def _find_meta(read_at: ReadAt, name: str) -> Box | None:
    """Find the "meta" box of a file, or the "moov" box of an animation before it.

    Raises:
        ImageTooLargeError: there are two "meta" boxes, of which decoders take either.
    """
    found = None
    all_boxes = boxes(read_at)
    for box in all_boxes:
        if box.kind in (b"meta", b"moov"):
            found = box
            break
    # A box after it that is cut off does not concern decoders.
    with suppress(ImageDecodeError, struct.error):
        if any(box.kind == b"meta" for box in all_boxes):
            raise ImageTooLargeError(f"the {name} has two 'meta' boxes: save it again")
    return found


def read_image_properties(read_at: ReadAt, iprp: Box) -> list[Box]:
    """List the properties of all images together."""
    containers = [box for box in boxes(read_at, iprp.start, iprp.end) if box.kind == b"ipco"]
    properties: list[Box] = []
    for container in containers:
        properties.extend(boxes(read_at, container.start, container.end))
    return properties


def property_values(
    read_at: ReadAt, properties: list[Box], kind: bytes, *, values_format: str, skip: int = 0
) -> set[tuple[int, ...]]:
    """Read the distinct values of a kind of property, after ``skip`` bytes.

    Raises:
        struct.error: the file ends within a property.
    """
    n_bytes = struct.calcsize(values_format)
    starts = [box.start + skip for box in properties if box.kind == kind]
    return {struct.unpack(values_format, read_at(start, n_bytes)) for start in starts}


def largest_size(read_at: ReadAt, properties: list[Box]) -> tuple[int, int] | None:
    """Read width and height of the largest image, before it is turned; None without a size.

    Raises:
        struct.error: the file ends within a property.
    """
    sizes = property_values(read_at, properties, b"ispe", values_format=">II", skip=4)
    if not sizes:
        return None
    width, height = max(sizes, key=math.prod)
    return width, height


def item_pieces(
    read_at: ReadAt, iloc: Box, idat: Box | None, *, name: str, limits: ItemLimits
) -> Iterator[Piece]:
    """Yield the pieces of each item: images, and metadata.

    Args:
        read_at: reads the file.
        iloc: the list of the items.
        idat: the box for small items; None if the file has none.
        name: format of the file, for messages.
        limits: limits on the number of items and pieces.

    Raises:
        ImageDecodeError: an item has too many pieces.
        ImageTooLargeError: there are too many items.
        struct.error: the file ends within the list of items.
    """
    read_bits = Bits(read_at(iloc.start, limits.list_bytes))
    version = read_bits(8)
    read_bits(24)  # flags
    offset_bits = 8 * read_bits(4)
    length_bits = 8 * read_bits(4)
    base_bits = 8 * read_bits(4)
    index_bits = 8 * read_bits(4)
    number_bits = 32 if version == 2 else 16
    n_items = read_bits(number_bits)
    if n_items > limits.items:
        raise ImageTooLargeError(f"the {name} has more than {limits.items} parts; save it again")
    for _ in range(n_items):
        item = read_bits(number_bits)
        method = _IN_FILE
        if version:
            method = read_bits(16) & 15
        read_bits(16)  # number of the file that holds the data
        base = read_bits(base_bits)
        in_file = method == _IN_FILE
        if method == _IN_IDAT and idat is not None:
            in_file = True
            base += idat.start
        n_pieces = read_bits(16)
        if n_pieces > limits.pieces:
            pieces = "several pieces" if limits.pieces == 1 else f"{n_pieces} pieces"
            raise ImageDecodeError(f"the {name} stores an image in {pieces}; save it again")
        for _ in range(n_pieces):
            if version:
                read_bits(index_bits)
            start = base + read_bits(offset_bits)
            length = read_bits(length_bits)
            yield Piece(item, start, length=length, in_file=in_file)


class Bits:
    """Reader of numbers of any width in bits; a call reads the next one."""

    def __init__(self, data: bytes) -> None:
        self._digits = iter("".join(f"{byte:08b}" for byte in data))

    def __call__(self, n: int) -> int:
        """Read the next number.

        Raises:
            struct.error: the data end within the number.
        """
        digits = "".join(islice(self._digits, n))
        if len(digits) < n:
            raise struct.error
        return int(digits or "0", 2)


def _is_heic(start: bytes) -> bool:
    return still_format(start) == "HEIC"


HEIC = ImageFormat(
    name="HEIC",
    suffixes=(".heic",),
    recognises=_is_heic,
    read_header=read_heic,
    opencv=False,
    # pi-heif has the names of pillow-heif, but no encoder.
    extra=DecoderExtra(name="heic", package="pi-heif", modules=("pillow_heif", "pi_heif")),
)
