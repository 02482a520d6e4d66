"""Make the tables of readings: ``python -m research.training.readings.table FOLDER``.

``FOLDER`` has the tables of chips (``sheets.py``) and ``readings/*.txt``, what was read on the sheets. Ends and sides:
a line with the sheet's name, then a line for each chip, ``number left right top bottom kind lean`` in chip pixels, with
``-`` for what is missing. Kinds: one line for each sheet, its name and the kinds of its chips. ``dup`` is a car that
another chip shows. Writes ``ends_and_sides.csv`` and ``kinds.csv`` beside this module.
"""

from __future__ import annotations

import argparse
import csv
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from research.training.detector.data import group_of
from research.training.readings.sheets import SAME_CAR, candidate_of, ground_position, read_chips
from research.training.readings.views import Chip

KINDS = (
    "kei", "small", "compact", "saloon", "suv", "pickup", "van",
    "lorry", "trailer", "container", "boat", "roof", "unclear",
)  # fmt: skip
HERE = Path(__file__).parent
_CHECKED_PLACES = ("fuji", "bergamo", "rotterdam")  # every reading there is kept for checking
_CHECKED_EVERY = 3  # group of photographs of the large sets
_LARGE = ("ucm", "cannes", "saopaulo", "estonia")
_DUPLICATE, _MISSING = "dup", "-"
_GSD = {"mashiki_z20": 0.12547, "mashiki_z21": 0.06273, "fuji": 0.03045, "bergamo": 0.05211, "garfield": 0.047}
_JAPAN = ("mashiki", "fuji")
_LONGEST_M = {"kei": 3.6, "small": 3.95, "compact": 4.45}  # of two-box bodies; a longer one is an estate
_EDGES = ("left", "right", "top", "bottom")


class Reading(NamedTuple):
    """One car's ends and sides as they were read, in chip pixels; None for an edge that is missing."""

    chip: Chip
    edges: tuple[float | None, ...]  # left, right, top, bottom
    body: str
    lean: str  # up, down, none: the side that the camera sees, on the chip


def parse_ends(notes: Path, chips: list[Chip]) -> Iterator[Reading]:
    """Read the notes on sheets of ends, without duplicates."""
    known = {(chip.sheet, chip.number): chip for chip in chips}
    sheet = ""
    for line in notes.read_text(encoding="utf-8").splitlines():
        first, *rest = line.split()
        if not rest:
            sheet = first
        elif rest[0] != _DUPLICATE:
            edges = tuple(None if cell == _MISSING else float(cell) for cell in rest[: len(_EDGES)])
            yield Reading(known[sheet, int(first)], edges, rest[4], rest[5])


def parse_kinds(notes: Path, chips: list[Chip]) -> Iterator[tuple[Chip, str]]:
    """Read the notes on sheets of kinds, duplicates included."""
    for line in notes.read_text(encoding="utf-8").splitlines():
        sheet, *kinds = line.split()
        of_sheet = [chip for chip in chips if chip.sheet == sheet]
        yield from zip(of_sheet, kinds, strict=True)


def _chips(folder: Path, pattern: str) -> list[Chip]:
    return [chip for path in sorted(folder.glob(pattern)) for chip in read_chips(path)]


def read_ends(folder: Path) -> Iterator[Reading]:
    """Read all notes on sheets of ends."""
    chips = _chips(folder, "ends*.csv")
    for path in sorted((folder / "readings").glob("ends*.txt")):
        yield from parse_ends(path, chips)


def read_kinds(folder: Path) -> Iterator[tuple[Chip, str]]:
    """Read all notes on sheets of kinds, each car once."""
    chips = _chips(folder, "kinds*.csv")
    read: set[tuple[str, tuple[float, ...]]] = set()
    for path in sorted((folder / "readings").glob("kinds*.txt")):
        for chip, kind in parse_kinds(path, chips):
            if kind != _DUPLICATE and (chip.file, chip.box) not in read:
                yield chip, kind
            read.add((chip.file, chip.box))


def in_image(reading: Reading) -> list[float | None]:
    """Offsets of both ends and both sides from the box's centre, along and across its axis, in image pixels."""
    view = reading.chip.view
    x, y, _, _, angle = reading.chip.box
    axes = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    out: list[float | None] = []
    for k, edge in enumerate(reading.edges):
        if edge is None:
            out.append(None)
            continue
        point = np.array([[edge, view.v] if k < len(_EDGES) // 2 else [view.u, edge]])
        out.append(float((axes @ (view.to_image(point)[0] - [x, y]))[k // 2]))
    return _ordered(out[:2]) + _ordered(out[2:])


def _ordered(pair: list[float | None]) -> list[float | None]:
    """Put the smaller offset first: a flipped or turned chip shows it on the other side."""
    first, second = pair
    if first is not None and second is not None:
        return [min(first, second), max(first, second)]
    known = first if first is not None else second
    if known is None:
        return [None, None]
    return [known, None] if known < 0 else [None, known]


def difference(pair: list[float | None]) -> float | None:
    """Distance between two edges; None if one is missing."""
    first, second = pair
    return None if first is None or second is None else second - first


def gsd_of(chip: Chip) -> float | None:
    """Metres per pixel of a photograph whose scale is known well enough to tell a small car from a saloon."""
    return next((gsd for name, gsd in _GSD.items() if name in chip.file), None)


def kind_of(body: str, length_m: float | None, place: str) -> str:
    """Kind of a body: two-box cars (``hatch``) by their length, small ones of Japan are kei."""
    if body in ("kei", "keitruck") and length_m is not None and length_m > _LONGEST_M["kei"]:
        body = "pickup" if body == "keitruck" else "hatch"
    if place in _JAPAN and body in ("van", "hatch") and length_m is not None and length_m <= _LONGEST_M["kei"]:
        return "kei"
    if body == "keitruck":
        return "kei"
    if body != "hatch":
        return body
    if length_m is None:
        return "compact"
    return next((name for name in ("small", "compact") if length_m <= _LONGEST_M[name]), "saloon")


def use_of(chip: Chip) -> str:
    """Return ``check`` for readings that are kept back: whole places, and whole groups of the large sets."""
    group = group_of(chip.file, chip.place).removesuffix("b")
    kept = chip.place in _LARGE and zlib.crc32(f"readings {group}".encode()) % _CHECKED_EVERY == 0
    return "check" if kept or chip.place in _CHECKED_PLACES else "train"


def _written(value: float | None) -> str:
    return "" if value is None else f"{value:.2f}"


def ends_row(reading: Reading) -> list[object]:
    """Row of ``ends_and_sides.csv``."""
    chip = reading.chip
    offsets = in_image(reading)
    length, width = difference(offsets[:2]), difference(offsets[2:])
    gsd = gsd_of(chip)
    kind = kind_of(reading.body, length * gsd if length and gsd else None, chip.place)
    missing = " ".join(
        name for name, value in zip(("end1", "end2", "side1", "side2"), offsets, strict=True) if value is None
    )
    lean = {"up": "side1", "down": "side2"}.get(reading.lean, "")
    return [
        chip.file, chip.place.removesuffix("_found"), *chip.box, *map(_written, offsets), _written(length),
        _written(width), missing, lean, kind, use_of(chip),
    ]  # fmt: skip


def kind_rows(folder: Path) -> Iterator[list[object]]:
    """Rows of ``kinds.csv``; a car that was measured at a known scale has the kind of its measurement."""
    measured: dict[str, list[tuple[float, float, float, str]]] = {}
    for reading in read_ends(folder):
        row = dict(zip(ENDS_COLUMNS, ends_row(reading), strict=True))
        at = ground_position(candidate_of(reading.chip))
        if at and row["length_px"] and gsd_of(reading.chip) and row["kind"] != "unclear":
            measured.setdefault(reading.chip.place, []).append((*at, str(row["kind"])))
    for chip, read in read_kinds(folder):
        at = ground_position(candidate_of(chip))
        near = [
            kind
            for x, y, length, kind in measured.get(chip.place, [])
            if at and np.hypot(at[0] - x, at[1] - y) < SAME_CAR * length
        ]
        kind = near[0] if near and read not in ("roof", "unclear") else read
        yield [chip.file, chip.place, chip.box[0], chip.box[1], chip.box[2], kind, use_of(chip)]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    options = parser.parse_args()
    with (HERE / "ends_and_sides.csv").open("w", newline="") as handle:
        writer = csv.writer(handle, lineterminator="\n")
        writer.writerow(ENDS_COLUMNS)
        writer.writerows(ends_row(reading) for reading in read_ends(options.folder))
    with (HERE / "kinds.csv").open("w", newline="") as handle:
        writer = csv.writer(handle, lineterminator="\n")
        writer.writerow(KINDS_COLUMNS)
        writer.writerows(kind_rows(options.folder))


ENDS_COLUMNS = (
    "file", "place", "x", "y", "box_length_px", "box_width_px", "box_angle", "end1_px", "end2_px", "side1_px",
    "side2_px", "length_px", "width_px", "missing", "camera_side", "kind", "use",
)  # fmt: skip
KINDS_COLUMNS = ("file", "place", "x", "y", "length_px", "kind", "use")

if __name__ == "__main__":
    main()
