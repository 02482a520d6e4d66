"""HEIC files that are put together from items, as an attacker would.

Every picture in them is the one of ``files.HEIC``, 64 x 64 px.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from tests.skill.imagery.files import HEIC
from vehanchor.imagery.formats.boxes import boxes
from vehanchor.imagery.formats.ifd import in_memory

SIDE_PX = 64


def box(kind: bytes, *contents: bytes) -> bytes:
    """Make a box."""
    content = b"".join(contents)
    return struct.pack(">I4s", 8 + len(content), kind) + content


def full_box(kind: bytes, *contents: bytes, version: int = 0, flags: int = 0) -> bytes:
    """Make a box with a version and flags."""
    return box(kind, struct.pack(">I", version << 24 | flags), *contents)


def _pixels_and_configuration() -> tuple[bytes, bytes]:
    """Cut the coded picture and its "hvcC" box out of ``HEIC``."""
    (media,) = [part for part in boxes(in_memory(HEIC)) if part.kind == b"mdat"]
    start = HEIC.index(b"hvcC") - 4
    (length,) = struct.unpack_from(">I", HEIC, start)
    n_bytes = 0xC4
    return HEIC[media.start : media.start + n_bytes], HEIC[start : start + length]


PIXELS, CONFIGURATION = _pixels_and_configuration()


class Item(NamedTuple):
    """Item of a HEIC.

    Attributes:
        kind: four letters.
        data: its bytes.
        side_px: side of its picture; 0 if it is none.
        text: its name and what follows, each with a zero byte.
        refers: kind of its references, and the numbers of the items to which it refers.
    """

    kind: bytes = b"hvc1"
    data: bytes = PIXELS
    side_px: int = SIDE_PX
    text: bytes = b"\0"
    refers: tuple[bytes, list[int]] | None = None


def heic(items: list[Item], primary: int | None = 1) -> bytes:
    """Make a HEIC of these items, whose numbers begin at 1; None leaves the primary one out."""
    media_start, meta = 0, b""
    for _ in range(2):  # the second time, the offsets are known
        meta = _meta(items, primary, media_start)
        start = box(b"ftyp", b"heic", bytes(4), b"mif1heic")
        media_start = len(start) + len(meta) + 8
    return start + meta + box(b"mdat", *[item.data for item in items])


def _meta(items: list[Item], primary: int | None, media_start: int) -> bytes:
    numbers = range(1, len(items) + 1)
    entries = [
        full_box(b"infe", struct.pack(">HH4s", number, 0, item.kind), item.text, version=2)
        for number, item in zip(numbers, items, strict=True)
    ]
    locations = []
    offset = media_start
    for number, item in zip(numbers, items, strict=True):
        locations.append(struct.pack(">HHHII", number, 0, 1, offset, len(item.data)))
        offset += len(item.data)
    parts = [full_box(b"hdlr", bytes(4), b"pict", bytes(13))]
    if primary is not None:
        parts.append(full_box(b"pitm", struct.pack(">H", primary)))
    parts += [
        full_box(b"iinf", struct.pack(">H", len(items)), *entries),
        full_box(b"iloc", b"\x44\0", struct.pack(">H", len(items)), *locations),
        _properties(items),
        full_box(b"iref", *_references(items)),
    ]
    return full_box(b"meta", *parts)


def _references(items: list[Item]) -> list[bytes]:
    references = []
    for number, item in enumerate(items, start=1):
        if item.refers is not None:
            kind, others = item.refers
            n_others = len(others)
            content = struct.pack(f">HH{n_others}H", number, n_others, *others)
            references.append(box(kind, content))
    return references


def _properties(items: list[Item]) -> bytes:
    sides = sorted({item.side_px for item in items})
    sizes = [full_box(b"ispe", struct.pack(">II", side, side)) for side in sides]
    associations = []
    for number, item in enumerate(items, start=1):
        indices = [2 + sides.index(item.side_px)] if item.side_px else []
        if item.kind == b"hvc1":
            indices.append(0x81)  # the configuration is essential
        associations.append(struct.pack(">HB", number, len(indices)) + bytes(indices))
    n_items = struct.pack(">I", len(items))
    return box(
        b"iprp",
        box(b"ipco", CONFIGURATION, *sizes),
        full_box(b"ipma", n_items, *associations),
    )


def grid(tiles: list[int], n_columns: int) -> Item:
    """Make a grid of pictures, with this number of columns."""
    n_rows = len(tiles) // n_columns
    width = n_columns * SIDE_PX
    height = n_rows * SIDE_PX
    data = struct.pack(">BBBBII", 0, 1, n_rows - 1, n_columns - 1, width, height)
    return Item(b"grid", data, side_px=max(width, height), refers=(b"dimg", tiles))


def overlay(pictures: list[int], side_px: int = SIDE_PX) -> Item:
    """Make an overlay of pictures, one upon the other."""
    places = bytes(8 * len(pictures))
    canvas = struct.pack(">II", side_px, side_px)
    data = b"\0\1" + bytes(8) + canvas + places
    return Item(b"iovl", data, side_px=side_px, refers=(b"dimg", pictures))


def identity(picture: int) -> Item:
    """Make an item that is the picture of another."""
    return Item(b"iden", b"", refers=(b"dimg", [picture]))


def nested_overlays(n_levels: int, n_pictures: int) -> bytes:
    """Make overlays of overlays: each of a level shows all pictures of the next."""
    items = [overlay(list(range(2, 2 + n_pictures)))]
    for level in range(1, n_levels):
        first = 2 + level * n_pictures
        pictures = list(range(first, first + n_pictures))
        items += [overlay(pictures) for _ in range(n_pictures)]
    items += [Item() for _ in range(n_pictures)]
    return heic(items)
