"""EXIF tags of the camera's geometry, read within bounds from untrusted bytes.

The reader visits three directories: the first, the camera's and the position's. It follows no other
pointers, so it cannot loop. It reads only known tags and a bounded number of values for each.
"""

from __future__ import annotations

import math
import struct
from typing import TYPE_CHECKING, TypeAlias

from vehanchor.imagery.metadata.blocks import MAX_XMP_BYTES

if TYPE_CHECKING:
    from collections.abc import Mapping

    from vehanchor.imagery.formats.ifd import ReadAt

ExifValue: TypeAlias = "str | float | bytes"
ExifTags: TypeAlias = dict[str, ExifValue]
"""Values by the tag's name in the EXIF standard: the first of several numbers, or decimal degrees. Invalid fractions
are absent."""

_NAMES = {
    0x010F: "Make",
    0x0110: "Model",
    0x02BC: "ApplicationNotes",  # XMP, in a TIFF
    0x9003: "DateTimeOriginal",
    0x920A: "FocalLength",
    0xA002: "PixelXDimension",
    0xA003: "PixelYDimension",
    0xA20E: "FocalPlaneXResolution",
    0xA210: "FocalPlaneResolutionUnit",
    0xA404: "DigitalZoomRatio",
    0xA405: "FocalLengthIn35mmFilm",
}
_POSITION_NAMES = {
    1: "GPSLatitudeRef",
    2: "GPSLatitude",
    3: "GPSLongitudeRef",
    4: "GPSLongitude",
}
_CAMERA_DIRECTORY = 0x8769
_POSITION_DIRECTORY = 0x8825
_POINTERS = (_CAMERA_DIRECTORY, _POSITION_DIRECTORY)
_SEXAGESIMAL = ("GPSLatitude", "GPSLongitude")
_MAX_ENTRIES = 512  # a real directory has some dozens
_MAX_TEXT_BYTES = 64
_BYTE = 1
_ASCII = 2
_LONG = 4
_IFD = 13
_UNDEFINED = 7
_RATIONAL = 5
_SIGNED_RATIONAL = 10
_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 7: 1, 9: 4, 10: 8, 11: 4, 12: 8}
_FORMATS = {1: "B", 3: "H", 4: "I", 5: "II", 9: "i", 10: "ii", 11: "f", 12: "d"}


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
    further = _read_directory(read_at, order, offset=first, tags=tags, names=_NAMES)
    for pointer, names in ((_CAMERA_DIRECTORY, _NAMES), (_POSITION_DIRECTORY, _POSITION_NAMES)):
        offset = further.get(pointer)
        if offset is not None and offset != first:
            _read_directory(read_at, order, offset=offset, tags=tags, names=names)
    return tags


def _read_directory(
    read_at: ReadAt, order: str, offset: int, tags: ExifTags, names: Mapping[int, str]
) -> dict[int, int]:
    """Read one directory into ``tags``, keeping earlier values; return the offsets of the directories it points to."""
    count_bytes = read_at(offset, 2)
    if len(count_bytes) < 2:
        return {}
    (n_entries,) = struct.unpack(order + "H", count_bytes)
    table = read_at(offset + 2, 12 * min(n_entries, _MAX_ENTRIES))
    further: dict[int, int] = {}
    for at in range(0, len(table) - 11, 12):
        tag, kind, count = struct.unpack_from(order + "HHI", table, at)
        if tag in _POINTERS and kind in (_LONG, _IFD):
            further.setdefault(tag, struct.unpack_from(order + "I", table, at + 8)[0])
        name = names.get(tag)
        if name is None or name in tags or kind not in _SIZES or count == 0:
            continue
        limit = MAX_XMP_BYTES if name == "ApplicationNotes" else _MAX_TEXT_BYTES
        if name == "ApplicationNotes" and kind not in (_BYTE, _ASCII, _UNDEFINED):
            continue
        whole = _SIZES[kind] * count
        wanted = min(whole, limit) if kind in (_BYTE, _ASCII, _UNDEFINED) else _SIZES[kind]
        if name in _SEXAGESIMAL:
            if kind != _RATIONAL or count != 3:
                continue
            wanted = whole
        (elsewhere,) = struct.unpack_from(order + "I", table, at + 8)
        raw = table[at + 8 : at + 8 + wanted] if whole <= 4 else read_at(elsewhere, wanted)
        read = _degrees if name in _SEXAGESIMAL else _value
        value = read(raw, kind, order) if len(raw) == wanted else None
        if value is not None:
            tags[name] = raw if name == "ApplicationNotes" else value
    return further


def _degrees(raw: bytes, _kind: int, order: str) -> ExifValue | None:
    parts = struct.unpack(order + "6I", raw)
    if not parts[1] or not all(parts[k + 1] or not parts[k] for k in (2, 4)):
        return None
    degrees: float = sum(parts[2 * k] / (parts[2 * k + 1] or 1) / 60.0**k for k in range(3))
    return degrees


def _value(raw: bytes, kind: int, order: str) -> ExifValue | None:
    if kind in (_ASCII, _UNDEFINED):
        return raw.split(b"\0", 1)[0].decode("ascii", "replace").strip()
    numbers = struct.unpack_from(order + _FORMATS[kind], raw)
    if kind in (_RATIONAL, _SIGNED_RATIONAL):
        return numbers[0] / numbers[1] if numbers[1] else None
    return float(numbers[0]) if math.isfinite(numbers[0]) else None
