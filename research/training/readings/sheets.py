"""Draw sheets for readings: ``python -m research.training.readings.sheets kinds|ends FOLDER``.

``FOLDER`` has ``candidates.csv`` (``research.training.readings.candidates``); the sheets and one table of their chips,
``kinds_NAME.csv`` or ``ends_NAME.csv``, go there. Cars of earlier tables are not drawn again. No box is drawn, and the
boxes set neither the place nor the size of a chip exactly, so that a reading does not follow them.
"""

from __future__ import annotations

import argparse
import csv
import re
import zlib
from collections import defaultdict
from collections.abc import Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np

from research.training.readings.candidates import Candidate, read_candidates
from research.training.readings.views import ENDS, KINDS, Chip, Layout, View, draw_sheet

_END_PX = (340.0, 420.0)  # of a car's length on sheets of ends
_KIND_PX = 105.0  # of the median car of a photograph on sheets of kinds
_SHIFT_PX = (16.0, 10.0)
_LEAST_WIDTH_PX = 20.0  # of a box, which is some 15 % wider than the body
_MOST_ENDS, _MOST_KINDS = 6, 16  # of one photograph
SAME_CAR = 0.4  # of a length: two boxes nearer than that on the ground are one car
_COARSE = "mashiki_z20"  # shows the ground of the finer images
_TILES_PX = 256  # side of a tile of a web map
_PIXELS_NAME = re.compile(r"_z(\d+)(x2|[bc])?_\d+_(\d+)_(\d+)$")
_TILES_NAME = re.compile(r"_z(\d+)_(\d+)_(\d+)$")


def ground_position(car: Candidate) -> tuple[float, float, float] | None:
    """Position on the ground and length, as shares of the web map's side; None where the name does not tell."""
    stem = Path(car.file).stem
    if found := _PIXELS_NAME.search(stem):
        zoom, left, top = int(found[1]) + (found[2] == "x2"), int(found[3]), int(found[4])
    elif found := _TILES_NAME.search(stem):
        zoom, left, top = int(found[1]), int(found[2]) * _TILES_PX, int(found[3]) * _TILES_PX
    else:
        return None
    side = _TILES_PX * 2.0**zoom
    return (left + car.x) / side, (top + car.y) / side, car.length / side


def distinct(cars: Iterable[Candidate]) -> list[Candidate]:
    """Leave out cars of a web map that an earlier image of the place shows; elsewhere the reader marks duplicates."""
    out: list[Candidate] = []
    seen: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
    for car in cars:
        at = ground_position(car)
        if at and any(np.hypot(at[0] - x, at[1] - y) < SAME_CAR * length for x, y, length in seen[car.place]):
            continue
        if at:
            seen[car.place].append(at)
        out.append(car)
    return out


def choose(cars: Sequence[Candidate], drawn: Sequence[Candidate], count: int) -> list[Candidate]:
    """Choose at most so many cars of each photograph, drawn ones included; neither score nor place decides which."""
    out: list[Candidate] = []
    of_file: dict[str, list[Candidate]] = defaultdict(list)
    for car in sorted(cars, key=lambda car: zlib.crc32(f"{car.file} {car.x} {car.y}".encode())):
        of_file[car.file].append(car)
    known = set(drawn)
    for file in sorted(of_file):
        before = [car for car in (*drawn, *out) if car.place == of_file[file][0].place]
        new = [car for car in distinct([*before, *of_file[file]])[len(distinct(before)) :] if car not in known]
        out += new[: max(0, count - sum(car.file == file for car in drawn))]
    return out


def wide_enough(cars: Sequence[Candidate]) -> list[Candidate]:
    """Select the cars whose sides can be read."""
    return [car for car in cars if car.width >= _LEAST_WIDTH_PX and car.score < 1 and _COARSE not in car.file]


def end_view(car: Candidate, rng: np.random.Generator, flip: int = 1, factor: float = 1.0) -> View:
    """Turn the car's axis to the horizontal."""
    du, dv = rng.uniform(-1, 1, 2) * _SHIFT_PX
    zoom = factor * rng.uniform(*_END_PX) / car.length
    return View(car.x, car.y, car.angle, zoom, flip, round(ENDS.width / 2 + du), round(ENDS.height / 2 + dv))


def kind_view(car: Candidate, median_px: float, rng: np.random.Generator, flip: int = 1, factor: float = 1.0) -> View:
    """Show the car as it stands, all cars of a photograph at one zoom."""
    angle = 0.0 if flip == 1 else float(rng.uniform(0, 2 * np.pi))
    return View(car.x, car.y, angle, factor * _KIND_PX / median_px, flip, KINDS.width / 2, KINDS.height / 2)


def median_lengths(cars: Sequence[Candidate]) -> dict[str, float]:
    """Median length of the boxes of each photograph, in pixels."""
    lengths: dict[str, list[float]] = defaultdict(list)
    for car in cars:
        lengths[car.file].append(car.length)
    return {file: float(np.median(values)) for file, values in lengths.items()}


def candidate_of(chip: Chip) -> Candidate:
    """Return the candidate that a chip shows."""
    x, y, length, width, angle = chip.box
    return Candidate(chip.file, chip.place, x, y, length, width, angle, chip.score)


def chips_of(name: str, cars: Sequence[Candidate], views: Sequence[View], layout: Layout) -> list[Chip]:
    """Number cars over as many sheets as they need."""
    per_sheet = layout.columns * layout.rows
    return [
        Chip(f"{name}_{k // per_sheet + 1:02}", k % per_sheet + 1, car.file, car.place, tuple(car.box), car.score, view)
        for k, (car, view) in enumerate(zip(cars, views, strict=True))
    ]


def write_sheets(chips: Sequence[Chip], layout: Layout, folder: Path, data: Path, table: str) -> None:
    """Write the sheets as PNG, and the table of their chips."""
    with (folder / f"{table}.csv").open("w", newline="") as handle:
        csv.writer(handle).writerows(chip.row() for chip in chips)
    for sheet in dict.fromkeys(chip.sheet for chip in chips):
        drawn = draw_sheet([chip for chip in chips if chip.sheet == sheet], layout, data)
        cv2.imwrite(str(folder / f"{sheet}.png"), drawn)


def read_chips(path: Path) -> list[Chip]:
    """Read the table of chips that ``write_sheets`` wrote."""
    with path.open(newline="") as handle:
        return [Chip.of_row(row) for row in csv.reader(handle)]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=("kinds", "ends"))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--places", default="", help="places to draw, comma between; all without it")
    parser.add_argument("--only", default="", help="regular expression of the files; all without it")
    parser.add_argument("--name", required=True, help="name of the sheets")
    parser.add_argument("--most", type=int, help="cars of one photograph")
    parser.add_argument("--limit", type=int, default=10_000, help="cars")
    options = parser.parse_args()
    everything = read_candidates(options.folder / "candidates.csv")
    places = options.places.split(",") if options.places else sorted({car.place for car in everything})
    rng = np.random.default_rng(zlib.crc32(options.places.encode()))
    name = f"{options.what}_{options.name}"
    cars = [car for place in places for car in everything if car.place == place and re.search(options.only, car.file)]
    drawn = [candidate_of(chip) for path in options.folder.glob(f"{options.what}*.csv") for chip in read_chips(path)]
    if options.what == "ends":
        cars = wide_enough(cars)
    chosen = choose(cars, drawn, options.most or (_MOST_ENDS if options.what == "ends" else _MOST_KINDS))
    chosen = chosen[:: max(1, len(chosen) // options.limit)][: options.limit]
    if options.what == "ends":
        views, layout = [end_view(car, rng) for car in chosen], ENDS
    else:
        medians = median_lengths(everything)
        views, layout = [kind_view(car, medians[car.file], rng) for car in chosen], KINDS
    write_sheets(chips_of(name, chosen, views, layout), layout, options.folder, options.data, name)


if __name__ == "__main__":
    main()
