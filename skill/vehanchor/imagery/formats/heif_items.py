"""Items of a HEIC: their texts, and what decoding the primary one makes libheif do.

A picture can be made of others: a grid, an overlay, or an identity. Each of them is decoded as
often as it is used: overlays of eight pictures, seven levels deep, are two million pictures in a
file of 10 KB.
"""

from __future__ import annotations

import struct
from collections import defaultdict
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.errors import ImageDecodeError, ImageTooLargeError
from vehanchor.imagery.formats.boxes import boxes

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vehanchor.imagery.formats.boxes import Box
    from vehanchor.imagery.formats.ifd import ReadAt


class Piece(NamedTuple):
    """Piece of an item's data.

    Attributes:
        item: number of the item.
        start: offset in the file.
        length: bytes; 0 if the file does not declare it.
        in_file: False if the piece lies within another item, whose offset counts from there, or in
            a box that the file lacks.
    """

    item: int
    start: int
    length: int
    in_file: bool


_MAX_LEVELS = 8
"""Maximum number of pictures made of each other; phones write two, a grid of tiles."""

_MIN_PICTURE_PX = 4096
"""Pixels that a picture counts at least: decoding the smallest takes some 0.1 ms."""

_MAX_DECODED_SHARE = 8
"""Decoded pixels per pixel of the largest picture. A choice.

A grid, its canvas and its alpha take up to four, if its last tiles are mostly outside.
"""

_MIN_DECODED_PX = 1 << 22
"""Decoded pixels that any file may have."""

_CANVAS_STARTS = {b"grid": 4, b"iovl": 10}
"""Bytes before the size of the canvas in the data of an item (ISO/IEC 23008-12, 6.6.2)."""

_MADE_OF = b"dimg"
_AUXILIARY_OF = b"auxl"


class _Items(NamedTuple):
    """Items of a file, by their numbers.

    Attributes:
        kinds: the kind of each, four letters.
        primary: the one to show.
        pixels: pixels of each picture.
        parts: pictures that are decoded for each picture: those of which it is made, and its alpha.
    """

    kinds: dict[int, bytes]
    primary: int
    pixels: dict[int, int]
    parts: dict[int, list[int]]


class _Work(NamedTuple):
    """Work of decoding a picture.

    Attributes:
        pixels: decoded pixels, its own among them.
        levels: levels of pictures made of each other.
    """

    pixels: int
    levels: int


def check_items(
    read_at: ReadAt, parts: dict[bytes, Box], properties: list[Box], pieces: list[Piece]
) -> None:
    """Check the items of a HEIC.

    Args:
        read_at: reads the file.
        parts: boxes of its "meta" box.
        properties: properties of its items.
        pieces: where their data lie.

    Raises:
        ImageDecodeError: a text is not UTF-8, there is no primary item, or a canvas is larger than
            any declared size, or stored in several pieces.
        ImageTooLargeError: the primary item is made of too many pictures.
        struct.error: the file ends within a box.
    """
    _check_auxiliary_types(read_at, properties)
    items = _read_items(read_at, parts, properties)
    if items.primary not in items.kinds:
        raise ImageDecodeError("the HEIC has no primary image: damaged")
    largest_px = max(items.pixels.values(), default=0)
    _check_canvases(read_at, items, pieces, largest_px)
    max_px = max(_MIN_DECODED_PX, _MAX_DECODED_SHARE * largest_px)
    work = _work(items, items.primary, level=1, done={})
    if work.pixels > max_px:
        raise ImageTooLargeError(
            f"the HEIC is made of pictures of {work.pixels} px, of which the largest has "
            f"{largest_px}: save it again as one picture"
        )


def _check_canvases(read_at: ReadAt, items: _Items, pieces: list[Piece], largest_px: int) -> None:
    """Check the canvases of grids and overlays, which libheif allocates by their own data.

    Raises:
        ImageDecodeError: a canvas is larger than any declared size, or in several pieces.
        struct.error: its data are too short.
    """
    checked = set()
    for piece in pieces:
        kind = items.kinds.get(piece.item)
        if kind not in _CANVAS_STARTS:
            continue
        if piece.item in checked or not piece.in_file:
            raise ImageDecodeError("the HEIC stores a canvas in several pieces: save it again")
        checked.add(piece.item)
        (flags,) = struct.unpack(">xB", read_at(piece.start, 2))
        size_format = ">II" if flags & 1 else ">HH"
        size_bytes = read_at(piece.start + _CANVAS_STARTS[kind], struct.calcsize(size_format))
        width, height = struct.unpack(size_format, size_bytes)
        canvas_px = width * height
        if canvas_px > largest_px:
            raise ImageDecodeError(
                f"the HEIC has a canvas of {width} x {height} px, larger than it declares: damaged"
            )
        known_px = items.pixels.get(piece.item, 0)
        items.pixels[piece.item] = max(canvas_px, known_px)


def _work(items: _Items, number: int, *, level: int, done: dict[int, _Work]) -> _Work:
    """Add up the work of decoding a picture and those of which it is made."""
    if number in done:
        work = done[number]
    else:
        if level > _MAX_LEVELS:
            raise _too_deep()
        works = []
        for part in items.parts.get(number, ()):
            works.append(_work(items, part, level=level + 1, done=done))
        own_px = max(_MIN_PICTURE_PX, items.pixels.get(number, 0))
        pixels = own_px + sum(part.pixels for part in works)
        levels_below = max((part.levels for part in works), default=0)
        work = _Work(pixels, levels_below + 1)
        done[number] = work
    if level + work.levels - 1 > _MAX_LEVELS:
        raise _too_deep()
    return work


def _too_deep() -> ImageTooLargeError:
    return ImageTooLargeError(
        f"the HEIC has pictures made of each other in more than {_MAX_LEVELS} levels: save it again"
    )


def _read_items(read_at: ReadAt, parts: dict[bytes, Box], properties: list[Box]) -> _Items:
    """Read what the boxes declare about the items.

    Raises:
        ImageDecodeError: a text is not UTF-8, or a box is missing.
        struct.error: the file ends within a box.
    """
    if b"pitm" not in parts or b"iinf" not in parts:
        raise ImageDecodeError("the HEIC has no primary image: damaged")
    number_format = ">I" if _version(read_at, parts[b"pitm"]) else ">H"
    n_bytes = struct.calcsize(number_format)
    (primary,) = struct.unpack(number_format, read_at(parts[b"pitm"].start + 4, n_bytes))
    return _Items(
        _read_kinds(read_at, parts[b"iinf"]),
        primary,
        pixels=_read_pixels(read_at, parts[b"iprp"], properties),
        parts=_read_parts(read_at, parts.get(b"iref")),
    )


def _version(read_at: ReadAt, box: Box) -> int:
    """Read the version of a box."""
    (version,) = struct.unpack(">B", read_at(box.start, 1))
    return int(version)


def _read_kinds(read_at: ReadAt, iinf: Box) -> dict[int, bytes]:
    """Read the kinds of all items by their numbers, and check their texts.

    Raises:
        ImageDecodeError: a text is not UTF-8.
    """
    count_bytes = 4 if _version(read_at, iinf) else 2
    kinds = {}
    for entry in boxes(read_at, iinf.start + 4 + count_bytes, iinf.end):
        if entry.kind != b"infe" or entry.end is None:
            continue
        version = _version(read_at, entry)
        number_format = ">I" if version == 3 else ">H"
        number_bytes = struct.calcsize(number_format)
        (number,) = struct.unpack(number_format, read_at(entry.start + 4, number_bytes))
        # The kind, the name and the type of the content follow the number and that of a protection.
        text_start = entry.start + 4 + number_bytes + 2
        text = read_at(text_start, max(0, entry.end - text_start))
        _check_text(text)
        kinds[number] = text[:4]
    return kinds


def _check_auxiliary_types(read_at: ReadAt, properties: list[Box]) -> None:
    """Check the texts that say what auxiliary pictures are.

    Raises:
        ImageDecodeError: one is not UTF-8.
    """
    for box in properties:
        if box.kind == b"auxC" and box.end is not None:
            text_start = box.start + 4
            content = read_at(text_start, max(0, box.end - text_start))
            text, _, _ = content.partition(b"\0")
            _check_text(text)


def _check_text(text: bytes) -> None:
    """Check a text, or several with zero bytes between them; pi-heif 1.4 crashes on others.

    Raises:
        ImageDecodeError: it is not UTF-8.
    """
    try:
        text.decode()
    except UnicodeDecodeError:
        raise ImageDecodeError(
            "the HEIC has a part whose type or name is no text: damaged"
        ) from None


def _read_parts(read_at: ReadAt, iref: Box | None) -> dict[int, list[int]]:
    """Read of which pictures each picture is made, and which alpha and depth belong to it."""
    parts: dict[int, list[int]] = defaultdict(list)
    if iref is None:
        return parts
    code = "I" if _version(read_at, iref) else "H"
    number_bytes = struct.calcsize(code)
    for reference in boxes(read_at, iref.start + 4, iref.end):
        if reference.kind not in (_MADE_OF, _AUXILIARY_OF):
            continue
        head = read_at(reference.start, number_bytes + 2)
        number, n_others = struct.unpack(f">{code}H", head)
        others_bytes = read_at(reference.start + number_bytes + 2, number_bytes * n_others)
        others = struct.unpack(f">{n_others}{code}", others_bytes)
        if reference.kind == _MADE_OF:
            parts[number].extend(others)
        else:
            for other in others:
                parts[other].append(number)
    return parts


def _read_pixels(read_at: ReadAt, iprp: Box, properties: list[Box]) -> dict[int, int]:
    """Read the pixels of each picture, by the sizes that are associated with it."""
    pixels: dict[int, int] = {}
    for association in boxes(read_at, iprp.start, iprp.end):
        if association.kind == b"ipma" and association.end is not None:
            content = read_at(association.start, association.end - association.start)
            for number, indices in _associations(content):
                sizes = [_size_px(read_at, properties, index) for index in indices]
                pixels[number] = max(sizes, default=0)
    return pixels


def _associations(content: bytes) -> Iterator[tuple[int, list[int]]]:
    """Yield each item's number and the places of its properties, from 1, of an "ipma" box.

    Raises:
        struct.error: the box ends within an item.
    """
    version_and_flags, n_items = struct.unpack_from(">II", content)
    number_code = "I" if version_and_flags >> 24 else "H"
    has_wide_indices = version_and_flags & 1
    index_code = "H" if has_wide_indices else "B"
    mask = 0x7FFF if has_wide_indices else 0x7F  # the highest bit says whether it is essential
    start = 8
    for _ in range(n_items):
        head_format = f">{number_code}B"
        number, n_indices = struct.unpack_from(head_format, content, start)
        start += struct.calcsize(head_format)
        indices_format = f">{n_indices}{index_code}"
        indices = struct.unpack_from(indices_format, content, start)
        start += struct.calcsize(indices_format)
        yield number, [index & mask for index in indices]


def _size_px(read_at: ReadAt, properties: list[Box], index: int) -> int:
    """Read the pixels that a property declares; 0 for one that is no size."""
    if not 1 <= index <= len(properties):
        return 0
    box = properties[index - 1]
    if box.kind != b"ispe":
        return 0
    width, height = struct.unpack(">II", read_at(box.start + 4, 8))
    return int(width * height)
