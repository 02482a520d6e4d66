"""Mutations of an image's structure: lengths, counts, kinds and values of its parts.

Blind mutations of a compressed image mostly damage its pixels. These change the numbers of boxes,
chunks, segments and directories, and move whole parts, and leave the rest of the file sound.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, TypeAlias, TypeVar

import numpy as np

from vehanchor.imagery.formats.header import FORMAT_BYTES, recognise_format

_Order: TypeAlias = Literal["little", "big"]
_T = TypeVar("_T")

_MAX_CONTENT_BYTES = 96
"""Bytes at the start of a part whose numbers are changed; pixels follow them."""

_SUPERBOXES = {
    b"meta": 4,
    b"iinf": 6,
    b"iref": 4,
    b"iprp": 0,
    b"ipco": 0,
    b"dinf": 0,
    b"jp2h": 0,
    b"res ": 0,
}
"""Boxes that contain boxes, and the bytes before the first."""

_KINDS = (
    *(b"ftyp", b"meta", b"hdlr", b"pitm", b"iloc", b"iinf", b"infe", b"iprp", b"ipco", b"ipma"),
    *(b"ispe", b"irot", b"imir", b"clap", b"pixi", b"colr", b"hvcC", b"av1C", b"auxC", b"iref"),
    *(b"dimg", b"cdsc", b"thmb", b"auxl", b"idat", b"mdat", b"grid", b"iovl", b"iden", b"hvc1"),
    *(b"av01", b"Exif", b"mime", b"uri ", b"tmap", b"mski", b"unci", b"jpeg", b"jp2h", b"jp2c"),
    *(b"ihdr", b"pclr", b"cmap", b"cdef", b"bpcc", b"res ", b"uuid", b"free", b"avif", b"mif1"),
    *(b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND", b"acTL", b"fcTL", b"fdAT", b"iCCP", b"zTXt"),
    *(b"iTXt", b"eXIf", b"gAMA", b"VP8X", b"VP8 ", b"VP8L", b"ALPH", b"ANIM", b"ANMF", b"ICCP"),
)
"""Names of parts that decoders know."""


class Number(NamedTuple):
    """Number in a file.

    Attributes:
        start: its offset.
        n_bytes: its bytes.
        order: its byte order.
    """

    start: int
    n_bytes: int
    order: _Order


class Part(NamedTuple):
    """Part of a file: a box, chunk, segment or directory entry.

    Attributes:
        start: its offset.
        end: offset of the byte after it.
        around: lengths of the parts that contain it.
    """

    start: int
    end: int
    around: tuple[Number, ...] = ()


@dataclass
class Structure:
    """Numbers and parts of a file."""

    numbers: list[Number] = field(default_factory=list)
    parts: list[Part] = field(default_factory=list)

    def add_numbers(self, start: int, end: int, order: _Order) -> None:
        """Add all bytes, and pairs and fours of bytes, of a content."""
        end = min(end, start + _MAX_CONTENT_BYTES)
        for n_bytes in (1, 2, 4):
            starts = range(start, end - n_bytes + 1, n_bytes)
            self.numbers += [Number(first, n_bytes, order) for first in starts]


def format_name(data: bytes) -> str:
    """Name the format of a file; ``none`` for an unknown one."""
    image_format = recognise_format(data[:FORMAT_BYTES])
    return image_format.name if image_format else "none"


def structure_of(data: bytes) -> Structure:
    """Find numbers and parts of a sound image; of an unknown file, those of its start."""
    structure = Structure()
    find = _FINDERS.get(format_name(data))
    if find is None:
        structure.add_numbers(0, len(data), "little")
        return structure
    try:
        find(data, structure)
    except struct.error:  # a file of the corpus that ends early on purpose
        structure.add_numbers(0, len(data), "big")
    return structure


def _find_boxes(data: bytes, structure: Structure) -> None:
    """Find the boxes of an AVIF, HEIC or JP2, and the segments of a JPEG 2000."""
    if data.startswith(b"\xff\x4f"):
        _find_codestream(data, 0, structure)
        return
    _find_boxes_between(data, 0, len(data), around=(), structure=structure)


def _find_boxes_between(
    data: bytes, start: int, end: int, *, around: tuple[Number, ...], structure: Structure
) -> None:
    while start + 8 <= end:
        length, kind = struct.unpack_from(">I4s", data, start)
        stated = Number(start, 4, "big")
        box_end = start + length if length >= 8 else end
        box_end = min(box_end, end)
        structure.parts.append(Part(start, box_end, around))
        structure.numbers += [stated, Number(start + 4, 4, "big")] * 4
        if kind in _SUPERBOXES:
            structure.add_numbers(start + 8, start + 8 + _SUPERBOXES[kind], "big")
            _find_boxes_between(
                data,
                start + 8 + _SUPERBOXES[kind],
                box_end,
                around=(*around, stated),
                structure=structure,
            )
        elif kind == b"jp2c":
            _find_codestream(data, start + 8, structure)
        else:
            structure.add_numbers(start + 8, box_end, "big")
        start = box_end


def _find_codestream(data: bytes, start: int, structure: Structure) -> None:
    """Find the marker segments of a JPEG 2000."""
    position = start + 2
    while position + 4 <= len(data):
        marker, length = struct.unpack_from(">HH", data, position)
        if marker == 0xFF93:  # pixels follow
            structure.add_numbers(position, len(data), "big")
            return
        end = position + 2 + length
        structure.parts.append(Part(position, end))
        structure.numbers += [Number(position, 2, "big"), Number(position + 2, 2, "big")] * 4
        structure.add_numbers(position + 4, end, "big")
        position = end


def _find_png_chunks(data: bytes, structure: Structure) -> None:
    position = 8
    while position + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        end = position + 12 + length
        structure.parts.append(Part(position, end))
        structure.numbers += [Number(position, 4, "big"), Number(position + 4, 4, "big")] * 4
        structure.add_numbers(position + 8, end - 4, "big")
        position = end


def _find_webp_chunks(data: bytes, structure: Structure) -> None:
    whole = Number(4, 4, "little")
    structure.numbers.append(whole)
    position = 12
    while position + 8 <= len(data):
        (length,) = struct.unpack_from("<I", data, position + 4)
        end = position + 8 + length + length % 2
        structure.parts.append(Part(position, end, (whole,)))
        structure.numbers += [Number(position, 4, "big"), Number(position + 4, 4, "little")] * 4
        structure.add_numbers(position + 8, end, "little")
        position = end


def _find_jpeg_segments(data: bytes, structure: Structure) -> None:
    position = 2
    while position + 4 <= len(data):
        marker, length = struct.unpack_from(">HH", data, position)
        end = position + 2 + length
        structure.parts.append(Part(position, end))
        structure.numbers += [Number(position, 2, "big"), Number(position + 2, 2, "big")] * 4
        structure.add_numbers(position + 4, end, "big")
        is_scan = marker == 0xFFDA
        position = data.find(b"\xff", end) if is_scan else end
        while is_scan and 0 <= position < len(data) - 1 and data[position + 1] in _IN_SCAN:
            position = data.find(b"\xff", position + 1)
        if position < 0:
            return


_IN_SCAN = frozenset({0, 0xFF, *range(0xD0, 0xD8)})
"""Bytes that follow 0xFF in the pixels of a JPEG."""


def _find_tiff_entries(data: bytes, structure: Structure) -> None:
    order: _Order = "little" if data.startswith(b"II") else "big"
    code = "<" if order == "little" else ">"
    structure.add_numbers(4, 8, order)
    (position,) = struct.unpack_from(code + "I", data, 4)
    visited: set[int] = set()
    while position and position not in visited:
        visited.add(position)
        (n_entries,) = struct.unpack_from(code + "H", data, position)
        structure.numbers.append(Number(position, 2, order))
        for start in range(position + 2, position + 2 + 12 * n_entries, 12):
            _, _, n_values, value = struct.unpack_from(code + "HHII", data, start)
            structure.parts.append(Part(start, start + 12))
            for offset, n_bytes in ((0, 2), (2, 2), (4, 4), (8, 4), (8, 2)):
                structure.numbers += [Number(start + offset, n_bytes, order)] * 2
            if n_values > 1 and value < len(data):
                structure.add_numbers(value, min(len(data), value + 16), order)
        next_start = position + 2 + 12 * n_entries
        structure.numbers.append(Number(next_start, 4, order))
        (position,) = struct.unpack_from(code + "I", data, next_start)


def _find_bmp_fields(data: bytes, structure: Structure) -> None:
    structure.add_numbers(2, 2 + _MAX_CONTENT_BYTES, "little")


_FINDERS: dict[str, Callable[[bytes, Structure], None]] = {
    "AVIF": _find_boxes,
    "HEIC": _find_boxes,
    "JPEG 2000": _find_boxes,
    "PNG": _find_png_chunks,
    "WebP": _find_webp_chunks,
    "JPEG": _find_jpeg_segments,
    "TIFF": _find_tiff_entries,
    "BMP": _find_bmp_fields,
}


class Mutator:
    """Maker of mutants, which change the structure of images.

    Args:
        corpus: sound images.
        seed: seed of the random choices.
    """

    def __init__(self, corpus: list[bytes], seed: int) -> None:
        self._random = np.random.default_rng(seed)
        self._corpus = [(data, structure_of(data)) for data in corpus]
        by_format: dict[str, list[tuple[bytes, Structure]]] = {}
        for data, structure in self._corpus:
            by_format.setdefault(format_name(data), []).append((data, structure))
        self._by_format = list(by_format.values())

    def __iter__(self) -> Iterator[bytes]:
        return self

    def __next__(self) -> bytes:
        # Every format has the same share, whatever the number of its images.
        of_a_format = self._choose(self._by_format)
        data, structure = self._choose(of_a_format)
        changed = bytearray(data)
        for _ in range(self._integer(1, 5)):
            self._change_number(changed, self._choose(structure.numbers))
        if structure.parts and self._integer(0, 4) == 0:
            self._change_part(changed, self._choose(structure.parts))
        keeps_checksums = self._integer(0, 10) > 0
        if keeps_checksums and changed.startswith(b"\x89PNG"):
            _mend_checksums(changed)
        return bytes(changed)

    def _integer(self, low: int, high: int) -> int:
        return int(self._random.integers(low, high))

    def _choose(self, choices: list[_T]) -> _T:
        return choices[self._integer(0, len(choices))]

    def _change_number(self, data: bytearray, number: Number) -> None:
        """Set a number to an edge, a neighbour, a name or anything."""
        end = number.start + number.n_bytes
        if end > len(data):
            return
        old = int.from_bytes(data[number.start : end], number.order)
        most = (1 << 8 * number.n_bytes) - 1
        values = [0, 1, 2, most, most >> 1, (most >> 1) + 1, old + 1, old - 1, 2 * old, old // 2]
        values += [len(data), len(data) - number.start, self._integer(0, 300)]
        values += [old ^ 1 << self._integer(0, 8 * number.n_bytes), self._integer(0, most + 1)]
        if number.n_bytes == 4:
            kind = _KINDS[self._integer(0, len(_KINDS))]
            values += [int.from_bytes(kind, number.order)] * 4
        value = self._choose(values) & most
        data[number.start : end] = value.to_bytes(number.n_bytes, number.order)

    def _change_part(self, data: bytearray, part: Part) -> None:
        """Remove a part, repeat it, or put one of another image in its place."""
        match self._integer(0, 4):
            case 0:
                content = b""
            case 1:
                content = bytes(data[part.start : part.end]) * self._integer(2, 40)
            case _:
                other, structure = self._choose(self._corpus)
                if not structure.parts:
                    return
                other_part = self._choose(structure.parts)
                content = other[other_part.start : other_part.end]
        growth = len(content) - (part.end - part.start)
        data[part.start : part.end] = content
        for number in part.around:
            end = number.start + number.n_bytes
            length = int.from_bytes(data[number.start : end], number.order) + growth
            length &= (1 << 8 * number.n_bytes) - 1
            data[number.start : end] = length.to_bytes(number.n_bytes, number.order)


def _mend_checksums(data: bytearray) -> None:
    """Compute the checksums of a PNG again, as far as its chunks can be followed."""
    position = 8
    while position + 12 <= len(data):
        (length,) = struct.unpack_from(">I", data, position)
        end = position + 8 + length
        if end + 4 > len(data):
            return
        checksum = zlib.crc32(data[position + 4 : end])
        struct.pack_into(">I", data, end, checksum)
        position = end + 4
