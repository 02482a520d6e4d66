"""EXIF tags of the camera's geometry, read within bounds from untrusted bytes.

The reader visits three directories: the first, the camera's and the position's. It follows no other
pointers, so it cannot loop. It reads only known tags and a bounded number of values for each.
"""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from vehanchor.imagery.metadata.blocks import MAX_XMP_BYTES

if TYPE_CHECKING:
    from collections.abc import Mapping

    from vehanchor.imagery.formats.ifd import ReadAt

ExifValue: TypeAlias = "str | float | bytes"
ExifTags: TypeAlias = dict[str, ExifValue]
"""Values by the tag's name in the EXIF standard.

A value is the first of several numbers, or an angle in decimal degrees. Invalid fractions are
absent.
"""

_APPLICATION_NOTES = "ApplicationNotes"
"""The tag in which a TIFF has its XMP."""

_NAMES = {
    0x0100: "ImageWidth",
    0x0101: "ImageLength",
    0x010F: "Make",
    0x0110: "Model",
    0x011A: "XResolution",
    0x011B: "YResolution",
    0x02BC: _APPLICATION_NOTES,
    0x9003: "DateTimeOriginal",
    0x920A: "FocalLength",
    0xA002: "PixelXDimension",
    0xA003: "PixelYDimension",
    0xA20E: "FocalPlaneXResolution",
    0xA210: "FocalPlaneResolutionUnit",
    0xA401: "CustomRendered",
    0xA404: "DigitalZoomRatio",
    0xA405: "FocalLengthIn35mmFilm",
    0xA434: "LensModel",
}
_POSITION_NAMES = {
    1: "GPSLatitudeRef",
    2: "GPSLatitude",
    3: "GPSLongitudeRef",
    4: "GPSLongitude",
}
_CAMERA_DIRECTORY = 0x8769
_POSITION_DIRECTORY = 0x8825
_NAMES_BY_POINTER = {_CAMERA_DIRECTORY: _NAMES, _POSITION_DIRECTORY: _POSITION_NAMES}
"""Tags of the directories to which the first one points."""

_SEXAGESIMAL = ("GPSLatitude", "GPSLongitude")
_MAX_ENTRIES = 512  # a real directory has some dozens
_MAX_TEXT_BYTES = 64

# Types of values, as in TIFF.
_BYTE = 1
_ASCII = 2
_LONG = 4
_RATIONAL = 5
_UNDEFINED = 7
_SIGNED_RATIONAL = 10
_IFD = 13
_TEXT_TYPES = (_BYTE, _ASCII, _UNDEFINED)
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 7: 1, 9: 4, 10: 8, 11: 4, 12: 8}
_FORMATS = {1: "B", 3: "H", 4: "I", 5: "II", 9: "i", 10: "ii", 11: "f", 12: "d"}

_ENTRY_BYTES = 12
_VALUE_OFFSET = 8
"""Bytes of an entry before its value, or before the offset of a value of more than 4 bytes."""


class _Entry(NamedTuple):
    """Entry of a directory.

    Attributes:
        tag: its number.
        kind: type of its values.
        n_values: number of its values.
        value: its last 4 bytes: the value, or the value's offset.
    """

    tag: int
    kind: int
    n_values: int
    value: bytes

    @property
    def n_bytes(self) -> int:
        """Bytes of all its values."""
        return _SIZES[self.kind] * self.n_values


def read_exif(read_at: ReadAt) -> ExifTags:
    """Read the known tags; damaged ones are absent.

    Args:
        read_at: reads the TIFF structure, with offsets from its first byte; classic TIFF only, as
            in EXIF.
    """
    head = read_at(0, 8)
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(head[:4])
    if order is None or len(head) < 8:
        return {}
    tags: ExifTags = {}
    (first,) = struct.unpack_from(order + "I", head, 4)
    pointers = _read_directory(read_at, order, offset=first, tags=tags, names=_NAMES)
    for pointer, names in _NAMES_BY_POINTER.items():
        offset = pointers.get(pointer)
        if offset is not None and offset != first:
            _read_directory(read_at, order, offset=offset, tags=tags, names=names)
    return tags


def _read_directory(
    read_at: ReadAt,
    order: str,
    *,
    offset: int,
    tags: ExifTags,
    names: Mapping[int, str],
) -> dict[int, int]:
    """Read one directory into ``tags``, keeping earlier values.

    Returns:
        Offsets of the directories to which it points, by their pointers.
    """
    count_bytes = read_at(offset, 2)
    if len(count_bytes) < 2:
        return {}
    (n_entries,) = struct.unpack(order + "H", count_bytes)
    table = read_at(offset + 2, _ENTRY_BYTES * min(n_entries, _MAX_ENTRIES))
    pointers: dict[int, int] = {}
    for start in range(0, len(table) - _ENTRY_BYTES + 1, _ENTRY_BYTES):
        tag, kind, n_values = struct.unpack_from(order + "HHI", table, start)
        value = table[start + _VALUE_OFFSET : start + _ENTRY_BYTES]
        entry = _Entry(tag, kind, n_values=n_values, value=value)
        is_pointer = tag in _NAMES_BY_POINTER and kind in (_LONG, _IFD)
        if is_pointer:
            pointers.setdefault(tag, _offset_in(entry, order))
        has_value = kind in _SIZES and n_values > 0
        name = names.get(tag)
        if name is None or name in tags or not has_value:
            continue
        tag_value = _read_tag(read_at, order, name=name, entry=entry)
        if tag_value is not None:
            tags[name] = tag_value
    return pointers


def _read_tag(read_at: ReadAt, order: str, *, name: str, entry: _Entry) -> ExifValue | None:
    """Read the value of a tag; None if it is damaged or has the wrong type."""
    is_text = entry.kind in _TEXT_TYPES
    if name == _APPLICATION_NOTES:
        if not is_text:
            return None
        n_bytes = min(entry.n_bytes, MAX_XMP_BYTES)
        return _read_value_bytes(read_at, order, entry, n_bytes)
    if name in _SEXAGESIMAL:
        if entry.kind != _RATIONAL or entry.n_values != 3:
            return None
        raw = _read_value_bytes(read_at, order, entry, entry.n_bytes)
        if raw is None:
            return None
        return _degrees(raw, order)
    n_bytes = _SIZES[entry.kind]  # of several numbers the first one counts
    if is_text:
        n_bytes = min(entry.n_bytes, _MAX_TEXT_BYTES)
    raw = _read_value_bytes(read_at, order, entry, n_bytes)
    if raw is None:
        return None
    return _text_or_number(raw, entry.kind, order)


def _read_value_bytes(read_at: ReadAt, order: str, entry: _Entry, n_bytes: int) -> bytes | None:
    """Read the first bytes of an entry's values; None if the file ends within them."""
    if entry.n_bytes <= len(entry.value):
        raw = entry.value[:n_bytes]
    else:
        raw = read_at(_offset_in(entry, order), n_bytes)
    return raw if len(raw) == n_bytes else None


def _offset_in(entry: _Entry, order: str) -> int:
    """Read an entry's value as an offset."""
    (offset,) = struct.unpack(order + "I", entry.value)
    return int(offset)


def _degrees(raw: bytes, order: str) -> float | None:
    """Convert degrees, minutes and seconds, three fractions, to decimal degrees.

    Degrees need a denominator; minutes and seconds of 0/0 count as 0.
    """
    numbers = struct.unpack(order + "6I", raw)
    if numbers[1] == 0:
        return None
    parts: list[float] = []
    for k in range(3):
        numerator = numbers[2 * k]
        denominator = numbers[2 * k + 1]
        if denominator == 0 and numerator != 0:
            return None
        parts.append(numerator / (denominator or 1) / 60.0**k)
    return sum(parts)


def _text_or_number(raw: bytes, kind: int, order: str) -> str | float | None:
    """Decode a text up to its first zero byte, or one number; None if the number is not finite."""
    if kind in (_ASCII, _UNDEFINED):
        text, _, _ = raw.partition(b"\0")
        return text.decode("ascii", "replace").strip()
    numbers = struct.unpack_from(order + _FORMATS[kind], raw)
    if kind in (_RATIONAL, _SIGNED_RATIONAL):
        numerator, denominator = numbers
        if denominator == 0:
            return None
        return float(numerator / denominator)
    number = float(numbers[0])
    return number if math.isfinite(number) else None
