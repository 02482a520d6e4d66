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

TIFF_SIGNATURES = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
"""First bytes of a classic TIFF and a BigTIFF, in either byte order."""

MAX_EXIF_BYTES = 1 << 16
"""Bytes of an EXIF block to read: JPEG allows no more, and the orientation is at the start."""

_BIGTIFF = 43
TAG_ORIENTATION = 274
_INTEGER_CODES = {1: "B", 3: "H", 4: "I", 13: "I", 16: "Q", 18: "Q"}
"""Codes of ``struct`` for the types of whole numbers."""

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
"""Maximum number of values read from a tag, one per band.

If the first 64 are equal, all count as equal.
"""


class _Form(NamedTuple):
    """Form of a TIFF's directories, classic or BigTIFF, in the codes of ``struct``.

    Attributes:
        order: byte order.
        first: offset of the first directory.
        n_entries: format of the number of entries, before a directory's table.
        entry: format of an entry's tag, type and count; its value follows.
        offset: format of an offset.
        value_bytes: bytes of a value, or of the offset of a longer one.
    """

    order: str
    first: int
    n_entries: str
    entry: str
    offset: str
    value_bytes: int

    @property
    def value_start(self) -> int:
        """Bytes of an entry before its value."""
        return struct.calcsize(self.entry)

    @property
    def entry_bytes(self) -> int:
        """Bytes of an entry."""
        return self.value_start + self.value_bytes


class _Entry(NamedTuple):
    """Entry of a directory.

    Attributes:
        tag: its number.
        kind: type of its values.
        n_values: number of its values.
        value_offset: offset of its value, or of the value's offset, in the table.
    """

    tag: int
    kind: int
    n_values: int
    value_offset: int


def read_ifd(
    read_at: ReadAt,
    integer_tags: frozenset[int],
    presence_tags: frozenset[int] = frozenset(),
    *,
    offset: int | None = None,
    whole: bool = True,
) -> dict[int, tuple[int, ...]]:
    """Read tags of a directory.

    Args:
        read_at: reads the file, or a block that begins with a TIFF signature.
        integer_tags: tags with integer values to read.
        presence_tags: tags to test for presence; their values are not read.
        offset: offset of the directory; None for the first.
        whole: whether the file is there to its end.

    Returns:
        Up to 64 values for each of these tags that is present.

    Raises:
        ImageDecodeError: a tag occurs twice, an integer tag holds no integers, or all values
            together, which decoders read, are longer than the file.
        struct.error: the file ends within the directory or a value.
    """
    form = _read_form(read_at)
    if offset is None:
        offset = form.first
    table_start, n_entries = _locate_table(read_at, form, offset=offset)
    entry_bytes = form.entry_bytes
    value_start = form.value_start
    table_bytes = n_entries * entry_bytes
    table = read_at(table_start, table_bytes)
    read_tags: set[int] = set()
    values: dict[int, tuple[int, ...]] = {}
    n_bytes_outside = 0
    for start in range(0, table_bytes, entry_bytes):
        tag, kind, n_values = struct.unpack_from(form.entry, table, start)
        if tag in read_tags:
            raise ImageDecodeError(
                f"the TIFF directory holds tag {tag} twice, and decoders disagree on it: damaged"
            )
        read_tags.add(tag)
        n_bytes = n_values * _TYPE_BYTES.get(kind, 0)
        if n_bytes > form.value_bytes:
            n_bytes_outside += n_bytes
        if tag in presence_tags:
            values[tag] = ()
        elif tag in integer_tags:
            entry = _Entry(tag, kind, n_values=n_values, value_offset=start + value_start)
            values[tag] = _read_integers(read_at, table, form=form, entry=entry)
    # Decoders read all values. If many entries share bytes, a small file can cost much memory.
    if whole and n_bytes_outside and not read_at(n_bytes_outside - 1, 1):
        raise ImageDecodeError(
            f"the TIFF directory declares values of {n_bytes_outside} bytes, more than the file "
            "has: damaged"
        )
    return values


def later_directories(read_at: ReadAt) -> Iterator[int]:
    """Yield the offsets of the directories after the first, as far as the chain can be followed.

    Raises:
        ImageDecodeError: the chain has more than a thousand directories.
    """
    form = _read_form(read_at)
    offset = form.first
    visited = {offset}
    with contextlib.suppress(struct.error):  # the chain leaves the file: every decoder stops here
        while True:
            table_start, n_entries = _locate_table(read_at, form, offset=offset)
            table_end = table_start + n_entries * form.entry_bytes
            next_offset = read_at(table_end, form.value_bytes)
            (offset,) = struct.unpack(form.offset, next_offset)
            if offset == 0 or offset in visited:
                return
            if len(visited) > _MAX_DIRECTORIES:
                raise ImageDecodeError(
                    f"the TIFF has more than {_MAX_DIRECTORIES} directories; save only the first"
                )
            visited.add(offset)
            yield offset


def _read_form(read_at: ReadAt) -> _Form:
    """Read the byte order and the version of a TIFF.

    Raises:
        ImageDecodeError: the byte order is unknown.
        struct.error: the file ends within its header.
    """
    head = read_at(0, 16)
    order = {b"II": "<", b"MM": ">"}.get(head[:2])
    if order is None:
        raise ImageDecodeError("the TIFF directory has no byte order: damaged")
    (version,) = struct.unpack_from(order + "H", head, 2)
    if version == _BIGTIFF:
        (first,) = struct.unpack_from(order + "Q", head, 8)
        return _Form(
            order,
            first,
            n_entries=order + "Q",
            entry=order + "HHQ",
            offset=order + "Q",
            value_bytes=8,
        )
    (first,) = struct.unpack_from(order + "I", head, 4)
    return _Form(
        order,
        first,
        n_entries=order + "H",
        entry=order + "HHI",
        offset=order + "I",
        value_bytes=4,
    )


def _locate_table(read_at: ReadAt, form: _Form, *, offset: int) -> tuple[int, int]:
    """Read the offset of a directory's entries, and their number.

    Raises:
        ImageDecodeError: there are too many entries.
        struct.error: the file ends before the directory.
    """
    count_bytes = struct.calcsize(form.n_entries)
    (n_entries,) = struct.unpack(form.n_entries, read_at(offset, count_bytes))
    if n_entries > _MAX_ENTRIES:
        raise ImageDecodeError(f"the TIFF directory declares {n_entries} entries: damaged")
    return offset + count_bytes, n_entries


def _read_integers(read_at: ReadAt, table: bytes, *, form: _Form, entry: _Entry) -> tuple[int, ...]:
    """Read up to 64 values of an entry, from the table or from their own offset.

    Raises:
        ImageDecodeError: the entry holds no integers.
        struct.error: the file ends within the values.
    """
    code = _INTEGER_CODES.get(entry.kind)
    if code is None or entry.n_values == 0:
        raise ImageDecodeError(
            f"the TIFF's tag {entry.tag} has {entry.n_values} values of type {entry.kind}, not "
            "whole numbers: damaged"
        )
    values_format = f"{form.order}{min(entry.n_values, MAX_VALUES)}{code}"
    if entry.n_values * _TYPE_BYTES[entry.kind] <= form.value_bytes:
        return struct.unpack_from(values_format, table, entry.value_offset)
    (values_offset,) = struct.unpack_from(form.offset, table, entry.value_offset)
    values = read_at(values_offset, struct.calcsize(values_format))
    return struct.unpack(values_format, values)


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
    values = tags.get(TAG_ORIENTATION) or (1,)
    orientation = values[0]
    return orientation if 1 <= orientation <= 8 else 1
