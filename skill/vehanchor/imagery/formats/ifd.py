"""Image file directories (IFD) of TIFF files and EXIF blocks.

Decoders read damaged directories differently: if a tag occurs twice, one uses the first, another
the last. The checked size must be the decoded size, so this reader refuses every ambiguous
directory.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable, Iterator
from typing import NamedTuple

from vehanchor.errors import ImageDecodeError

ReadAt = Callable[[int, int], bytes]
"""``read_at(offset, count)`` returns ``count`` bytes, fewer only at the end of the file."""

TIFF_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")  # classic and BigTIFF, either byte order
TAG_ORIENTATION = 274
_INTEGER_TYPES = {1: "B", 3: "H", 4: "I", 13: "I", 16: "Q", 18: "Q"}
_TYPE_BYTES = {
    1: 1,
    2: 1,
    3: 2,
    4: 4,
    5: 8,
    6: 1,
    7: 1,
    8: 2,
    9: 4,
    10: 8,
    11: 4,
    12: 8,
    13: 4,
    16: 8,
    17: 8,
    18: 8,
}
_MAX_DIRECTORIES = 1000
_MAX_ENTRIES = 4096  # a real directory has some dozens
MAX_VALUES = 64
"""Maximum number of values read from a tag, one per band. If the first 64 are equal, all count as equal."""


class _Form(NamedTuple):
    """Number formats of a TIFF's directories, and the offset of the first directory."""

    order: str
    first: int
    n_entries: str
    entry: str
    value_bytes: int


def read_ifd(
    read_at: ReadAt,
    wanted: frozenset[int],
    bare: frozenset[int] = frozenset(),
    *,
    offset: int | None = None,
    whole: bool = True,
) -> dict[int, tuple[int, ...]]:
    """Read tags of a directory.

    Args:
        read_at: reads the file, or a block that begins with a TIFF signature.
        wanted: tags with integer values to read.
        bare: tags to test for presence; their values are not read.
        offset: offset of the directory; None for the first.
        whole: whether the file is there to its end.

    Returns:
        Up to 64 values for each of these tags that is present.

    Raises:
        ImageDecodeError: a tag occurs twice, a wanted tag holds no integers, or all values
            together, which decoders read, are longer than the file.
        struct.error: the file ends within the directory or a value.
    """
    form = _form(read_at)
    entry_format = form.entry
    value_bytes = form.value_bytes
    order = form.order
    value_at = struct.calcsize(entry_format)
    entry_bytes = value_at + value_bytes
    table_at, n_entries = _table(read_at, form, form.first if offset is None else offset)
    table = read_at(table_at, n_entries * entry_bytes)
    seen: set[int] = set()
    tags: dict[int, tuple[int, ...]] = {}
    outside = 0
    for start in range(0, n_entries * entry_bytes, entry_bytes):
        tag, kind, count = struct.unpack_from(entry_format, table, start)
        if tag in seen:
            raise ImageDecodeError(
                f"the TIFF directory holds tag {tag} twice, and decoders disagree on it: damaged"
            )
        seen.add(tag)
        n_bytes = count * _TYPE_BYTES.get(kind, 0)
        outside += n_bytes if n_bytes > value_bytes else 0
        if tag in bare:
            tags[tag] = ()
        elif tag in wanted:
            tags[tag] = _values(
                read_at, table, start + value_at, order, (tag, kind, count), value_bytes
            )
    if whole and outside and not read_at(outside - 1, 1):
        raise ImageDecodeError(
            f"the TIFF directory declares values of {outside} bytes, more than the file has: "
            "damaged"
        )
    return tags


def later_directories(read_at: ReadAt) -> Iterator[int]:
    """Yield the offsets of the directories after the first, as far as the chain can be followed.

    Raises:
        ImageDecodeError: the chain has more than a thousand directories.
    """
    form = _form(read_at)
    at = form.first
    seen = {form.first}
    entry_bytes = struct.calcsize(form.entry) + form.value_bytes
    with contextlib.suppress(struct.error):  # the chain leaves the file: every decoder stops here
        while True:
            table_at, n_entries = _table(read_at, form, at)
            offset_format = form.order + ("I" if form.value_bytes == 4 else "Q")
            next_at = read_at(table_at + n_entries * entry_bytes, form.value_bytes)
            (at,) = struct.unpack(offset_format, next_at)
            if at == 0 or at in seen:
                return
            if len(seen) > _MAX_DIRECTORIES:
                raise ImageDecodeError(
                    f"the TIFF has more than {_MAX_DIRECTORIES} directories; save only the first"
                )
            seen.add(at)
            yield at


def _form(read_at: ReadAt) -> _Form:
    head = read_at(0, 16)
    order = {b"II": "<", b"MM": ">"}.get(head[:2])
    if order is None:
        raise ImageDecodeError("the TIFF directory has no byte order: damaged")
    (version,) = struct.unpack_from(order + "H", head, 2)
    if version == 43:  # BigTIFF
        (first,) = struct.unpack_from(order + "Q", head, 8)
        return _Form(order, first, n_entries=order + "Q", entry=order + "HHQ", value_bytes=8)
    (first,) = struct.unpack_from(order + "I", head, 4)
    return _Form(order, first, n_entries=order + "H", entry=order + "HHI", value_bytes=4)


def _table(read_at: ReadAt, form: _Form, offset: int) -> tuple[int, int]:
    """Give the offset of a directory's entries and their number."""
    count_bytes = struct.calcsize(form.n_entries)
    (n_entries,) = struct.unpack(form.n_entries, read_at(offset, count_bytes))
    if n_entries > _MAX_ENTRIES:
        raise ImageDecodeError(f"the TIFF directory declares {n_entries} entries: damaged")
    return offset + count_bytes, n_entries


def _values(
    read_at: ReadAt,
    table: bytes,
    at: int,
    order: str,
    entry: tuple[int, int, int],
    value_bytes: int,
) -> tuple[int, ...]:
    tag, kind, count = entry
    if kind not in _INTEGER_TYPES or count == 0:
        raise ImageDecodeError(
            f"the TIFF's tag {tag} has {count} values of type {kind}, not whole numbers: damaged"
        )
    values = f"{order}{min(count, MAX_VALUES)}{_INTEGER_TYPES[kind]}"
    if count * struct.calcsize(order + _INTEGER_TYPES[kind]) <= value_bytes:
        return struct.unpack_from(values, table, at)
    (elsewhere,) = struct.unpack_from(order + ("I" if value_bytes == 4 else "Q"), table, at)
    return struct.unpack(values, read_at(elsewhere, struct.calcsize(values)))


def in_memory(data: bytes) -> ReadAt:
    """Make the reader of a file or block in memory."""
    return lambda offset, count: data[offset : offset + count]


def exif_orientation(payload: bytes) -> int:
    """Read the orientation of an EXIF block, 1 to 8; 1 if it is absent or damaged."""
    try:
        tags = read_ifd(in_memory(payload), frozenset({TAG_ORIENTATION}), whole=False)
    except (struct.error, ImageDecodeError):  # damaged metadata leaves the pixels usable
        return 1
    return orientation_of(tags)


def orientation_of(tags: dict[int, tuple[int, ...]]) -> int:
    """Get the orientation from a directory's tags, 1 to 8; 1 if it is absent or invalid."""
    value = (tags.get(TAG_ORIENTATION) or (1,))[0]
    return value if 1 <= value <= 8 else 1
