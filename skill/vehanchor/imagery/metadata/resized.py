"""Metadata of a JPEG for a resized copy: position and camera stay, sizes become true again."""

from __future__ import annotations

import struct
from fractions import Fraction

_SOI = b"\xff\xd8"
_APP1 = 0xE1
_START_OF_SCAN = 0xDA
_EXIF = b"Exif\0\0"
_XMP = b"http://ns.adobe.com/xap/1.0/\0"
_BYTE_ORDERS = {b"II*\0": "<", b"MM\0*": ">"}
_ENTRY_BYTES = 12
_SHORT = 3
_LONG = 4
_RATIONAL = 5
_ORIENTATION = 0x0112
_EXIF_FOLDER = 0x8769
# Tags that are sizes of the image, by whether they are widths.
_WIDTHS = (0x0100, 0xA002)
_HEIGHTS = (0x0101, 0xA003)
# Pixels of the focal plane per unit, across and down.
_FOCAL_PLANE = (0xA20E, 0xA20F)
_MAX_PART = 10_000


def metadata_of_copy(
    jpeg: bytes, width_px: int, height_px: int, *, across: float, down: float
) -> list[bytes]:
    """Take the EXIF and XMP segments of a JPEG, for an upright copy of another size.

    The orientation becomes upright, sizes become those of the copy, and the resolution of the
    focal plane is rescaled. The preview is left out. Other tags, such as position, height and lens,
    stay.

    Args:
        jpeg: the file.
        width_px: width of the copy.
        height_px: height of the copy.
        across: width of the copy over that of the upright image.
        down: height of the copy over that of the upright image.

    Returns:
        Whole segments, to insert behind the start of the copy; none for a file without metadata.
    """
    segments = []
    for content in _app1_segments(jpeg):
        if content.startswith(_XMP):
            segments.append(_segment(content))
        elif content.startswith(_EXIF):
            block = bytearray(content[len(_EXIF) :])
            try:
                _correct(block, (width_px, height_px), (across, down))
            except struct.error:
                # A damaged block could state anything.
                continue
            segments.append(_segment(_EXIF + bytes(block)))
    return segments


def with_metadata(jpeg: bytes, segments: list[bytes]) -> bytes:
    """Insert segments behind the start of a JPEG."""
    return b"".join([_SOI, *segments, jpeg[len(_SOI) :]])


def _segment(content: bytes) -> bytes:
    return struct.pack(">BBH", 0xFF, _APP1, len(content) + 2) + content


def _app1_segments(jpeg: bytes) -> list[bytes]:
    """List the contents of the APP1 segments before the pixels."""
    contents = []
    place = len(_SOI)
    while place + 4 <= len(jpeg) and jpeg[place] == 0xFF:
        kind = jpeg[place + 1]
        if kind == _START_OF_SCAN:
            break
        (n_bytes,) = struct.unpack_from(">H", jpeg, place + 2)
        if kind == _APP1:
            contents.append(jpeg[place + 4 : place + 2 + n_bytes])
        place += 2 + n_bytes
    return contents


def _correct(block: bytearray, size: tuple[int, int], factors: tuple[float, float]) -> None:
    """Correct an EXIF block in place.

    Raises:
        struct.error: the block is damaged.
    """
    order = _BYTE_ORDERS.get(bytes(block[:4]))
    if order is None:
        raise struct.error("no byte order")
    turned = _turned(block, order)
    (first,) = struct.unpack_from(f"{order}I", block, 4)
    folders = [first]
    while folders:
        folder = folders.pop()
        (n_entries,) = struct.unpack_from(f"{order}H", block, folder)
        for number in range(n_entries):
            entry = folder + 2 + number * _ENTRY_BYTES
            tag, kind, _, value = struct.unpack_from(f"{order}HHII", block, entry)
            if tag == _EXIF_FOLDER and folder == first:
                folders.append(value)
            elif tag == _ORIENTATION:
                _write_integer(block, entry, order, kind=kind, value=1)
            elif tag in _WIDTHS:
                _write_integer(block, entry, order, kind=kind, value=size[0])
            elif tag in _HEIGHTS:
                _write_integer(block, entry, order, kind=kind, value=size[1])
            elif tag in _FOCAL_PLANE and kind == _RATIONAL:
                # A quarter turn swaps both directions of the copy; the focal plane is not turned.
                direction = _FOCAL_PLANE.index(tag) ^ turned
                _rescale(block, value, order, factors[direction])
        if folder == first:
            # Without the second folder there is no preview.
            struct.pack_into(f"{order}I", block, folder + 2 + n_entries * _ENTRY_BYTES, 0)


def _turned(block: bytearray, order: str) -> int:
    """Return 1 if the orientation swaps rows and columns, else 0."""
    (first,) = struct.unpack_from(f"{order}I", block, 4)
    (n_entries,) = struct.unpack_from(f"{order}H", block, first)
    for number in range(n_entries):
        entry = first + 2 + number * _ENTRY_BYTES
        (tag,) = struct.unpack_from(f"{order}H", block, entry)
        if tag == _ORIENTATION:
            (orientation,) = struct.unpack_from(f"{order}H", block, entry + 8)
            return int(orientation >= 5)
    return 0


def _write_integer(block: bytearray, entry: int, order: str, *, kind: int, value: int) -> None:
    if kind == _SHORT:
        struct.pack_into(f"{order}HH", block, entry + 8, min(value, 0xFFFF), 0)
    elif kind == _LONG:
        struct.pack_into(f"{order}I", block, entry + 8, value)


def _rescale(block: bytearray, place: int, order: str, factor: float) -> None:
    """Multiply a rational number."""
    numerator, denominator = struct.unpack_from(f"{order}II", block, place)
    if not denominator:
        return
    number = Fraction(numerator, denominator) * Fraction(factor).limit_denominator(_MAX_PART)
    scaled = number.limit_denominator(_MAX_PART)
    if scaled.numerator < 1 << 32:
        struct.pack_into(f"{order}II", block, place, scaled.numerator, scaled.denominator)
