"""Cut the chips of cars that were read by eye: ``python -m research.training.chips.readings OUT``.

Each car of ``research/training/readings`` is stored 60 px long, with 200 px of surroundings, as
fine as its image allows.
"""

from __future__ import annotations

import argparse
import csv
import math
from pathlib import Path
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from research.training.chips.kinds import kind_index
from research.training.chips.mine import GSD_M_PER_PX
from vehanchor.detection.verifier import surroundings
from vehanchor.storage.atomic import whole_file

Chips: TypeAlias = NDArray[np.uint8]
"""Chips ``[n, h, w, 3]``."""

Lengths: TypeAlias = NDArray[np.float64]
"""A length ``[n]`` of each chip."""

Names: TypeAlias = NDArray[np.str_]
"""A name ``[n]`` of each chip."""

READ_PX = 200
READ_LENGTH_PX = 60.0
_TABLES = Path(__file__).parents[1] / "readings"
_EDGES = ("end1_px", "end2_px", "side1_px", "side2_px")
_GSD_OF_SET = {**GSD_M_PER_PX, "estonia": 0.20, "garfield": 0.047}


class Read(NamedTuple):
    """Read cars.

    Attributes:
        chips: ``[n, 200, 200, 3]`` uint8.
        edges: ``[n, 4]`` both ends and both sides from the box's centre, in box lengths; NaN where
            missing.
        kind: ``[n]`` index into ``KINDS``, or -1.
        length_px: ``[n]`` of the box.
        width_px: ``[n]`` of the box; NaN for a reading of a kind alone.
        gsd: ``[n]`` metres per pixel, NaN where unknown.
        place: ``[n]`` names.
        source: ``[n]`` names of files.
        check: ``[n]`` whether it is kept back.
    """

    chips: Chips
    edges: NDArray[np.float32]
    kind: NDArray[np.int64]
    length_px: Lengths
    width_px: Lengths
    gsd: Lengths
    place: Names
    source: Names
    check: NDArray[np.bool_]

    def take(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> Read:
        """Select cars."""
        return Read(*(column[which] for column in self))  # type: ignore[arg-type]


def load(path: Path) -> Read:
    """Load the file that ``main`` wrote."""
    with np.load(path) as stored:
        return Read(**{name: stored[name] for name in Read._fields})


def scales(data: Path) -> dict[str, float]:
    """Read the metres per pixel by file, where they are known."""
    gsd_by_file: dict[str, float] = {}
    for folder, table in (("fleets", "table.csv"), ("chia", "crops.csv")):
        with (data / folder / table).open(newline="") as handle:
            for row in csv.DictReader(handle):
                gsd_by_file[f"{folder}/{row['file']}"] = float(row["gsd_m_per_px"])
    return gsd_by_file


def _rows(name: str) -> list[dict[str, str]]:
    with (_TABLES / name).open(newline="") as handle:
        return list(csv.DictReader(handle))


def collect(data: Path) -> Read:
    """Cut the chips of both tables.

    A car that the table of ends has is left out of the table of kinds.
    """
    gsd_by_file = scales(data)
    cars = _cars()
    images: dict[str, NDArray[np.uint8]] = {}
    chips = []
    for car in cars:
        if car.file not in images:
            image = cv2.imread(str(data / car.file), cv2.IMREAD_COLOR)
            if image is None:
                raise FileNotFoundError(car.file)
            images[car.file] = np.ascontiguousarray(image[:, :, ::-1]).astype(np.uint8)
        chip = surroundings(images[car.file], car.box, side_px=READ_PX, length_px=READ_LENGTH_PX)
        chips.append(chip[0])
    return Read(
        np.stack(chips),
        np.array([car.edges for car in cars], np.float32),
        kind=np.array([kind_index(car.kind) for car in cars]),
        length_px=np.array([car.box[2] for car in cars]),
        width_px=np.array([car.width_px for car in cars]),
        gsd=np.array(
            [gsd_by_file.get(car.file, _GSD_OF_SET.get(car.place, np.nan)) for car in cars]
        ),
        place=np.array([car.place for car in cars]),
        source=np.array([car.file for car in cars]),
        check=np.array([car.check for car in cars]),
    )


class _Car(NamedTuple):
    """Car of a table; see ``Read``."""

    file: str
    place: str
    kind: str
    check: bool
    box: NDArray[np.float64]
    edges: list[float]
    width_px: float


def _cars() -> list[_Car]:
    """Read the cars of both tables, each once."""
    cars = []
    boxes_by_file: dict[str, list[NDArray[np.float64]]] = {}
    for row in _rows("ends_and_sides.csv"):
        names = ("x", "y", "box_length_px", "box_width_px", "box_angle")
        box = np.array([float(row[name]) for name in names])
        edges = [float(row[name] or "nan") / box[2] for name in _EDGES]
        boxes_by_file.setdefault(row["file"], []).append(box)
        cars.append(_car(row, box, edges=edges, width_px=box[3]))
    for row in _rows("kinds.csv"):
        x, y, length, angle = [float(row[name]) for name in ("x", "y", "length_px", "angle")]
        box = np.array([x, y, length, 0.45 * length, angle])
        measured = boxes_by_file.get(row["file"], [])
        gaps = [math.dist(other[:2], (x, y)) for other in measured]
        if not any(gap < 0.3 * length for gap in gaps):
            cars.append(_car(row, box, edges=[np.nan] * 4, width_px=np.nan))
    return cars


def _car(
    row: dict[str, str], box: NDArray[np.float64], edges: list[float], width_px: float
) -> _Car:
    return _Car(
        file=row["file"],
        place=row["place"].removesuffix("_found"),
        kind=row["kind"],
        check=row["use"] == "check",
        box=box,
        edges=edges,
        width_px=width_px,
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    options = parser.parse_args()
    read = collect(options.data)
    with whole_file(options.out) as partial, partial.open("wb") as handle:
        np.savez(handle, **read._asdict())
    whole = np.isfinite(read.edges).all(axis=1)
    print(
        f"{len(read.kind)} cars, {whole.sum()} with all edges, "
        f"{(read.kind >= 0).sum()} of a kind, {read.check.sum()} kept back"
    )


if __name__ == "__main__":
    main()
