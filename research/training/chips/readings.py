"""Chips of cars that were read by eye: ``python -m research.training.chips.readings OUT.npz``.

Each car of ``research/training/readings`` is stored 60 px long, with 200 px of surroundings, as
fine as its image allows.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from research.training.chips.kinds import kind_index
from research.training.chips.mine import GSD_M_PER_PX
from vehanchor.detection.verifier import surroundings
from vehanchor.storage.atomic import whole_file

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

    chips: NDArray[np.uint8]
    edges: NDArray[np.float32]
    kind: NDArray[np.int64]
    length_px: NDArray[np.float64]
    width_px: NDArray[np.float64]
    gsd: NDArray[np.float64]
    place: NDArray[np.str_]
    source: NDArray[np.str_]
    check: NDArray[np.bool_]

    def take(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> Read:
        """Select cars."""
        return Read(*(each[which] for each in self))  # type: ignore[arg-type]


def load(path: Path) -> Read:
    """Read what ``main`` wrote."""
    with np.load(path) as stored:
        return Read(**{name: stored[name] for name in Read._fields})


def scales(data: Path) -> dict[str, float]:
    """Metres per pixel by file, where they are known."""
    out: dict[str, float] = {}
    for folder, table in (("fleets", "table.csv"), ("chia", "crops.csv")):
        with (data / folder / table).open(newline="") as handle:
            out |= {
                f"{folder}/{row['file']}": float(row["gsd_m_per_px"])
                for row in csv.DictReader(handle)
            }
    return out


def _rows(name: str) -> list[dict[str, str]]:
    with (_TABLES / name).open(newline="") as handle:
        return list(csv.DictReader(handle))


def collect(data: Path) -> Read:
    """Cut the chips of both tables; a car of the table of ends is left out of that of kinds."""
    known = scales(data)
    parts = []
    measured: dict[str, list[NDArray[np.float64]]] = {}
    for row in _rows("ends_and_sides.csv"):
        names = ("x", "y", "box_length_px", "box_width_px", "box_angle")
        box = np.array([float(row[name]) for name in names])
        edges = [float(row[name] or "nan") / box[2] for name in _EDGES]
        measured.setdefault(row["file"], []).append(box)
        parts.append((row, box, edges, box[3]))
    for row in _rows("kinds.csv"):
        x, y, length, angle = (float(row[name]) for name in ("x", "y", "length_px", "angle"))
        box = np.array([x, y, length, 0.45 * length, angle])
        seen = [
            other
            for other in measured.get(row["file"], [])
            if np.hypot(*(other[:2] - (x, y))) < 0.3 * length
        ]
        if not seen:
            parts.append((row, box, [np.nan] * 4, np.nan))
    images: dict[str, NDArray[np.uint8]] = {}
    chips = []
    for row, box, _, _ in parts:
        if row["file"] not in images:
            image = cv2.imread(str(data / row["file"]), cv2.IMREAD_COLOR)
            if image is None:
                raise FileNotFoundError(row["file"])
            images[row["file"]] = np.ascontiguousarray(image[:, :, ::-1]).astype(np.uint8)
        chips.append(
            surroundings(images[row["file"]], box, side_px=READ_PX, length_px=READ_LENGTH_PX)[0]
        )
    places = [row["place"].removesuffix("_found") for row, *_ in parts]
    return Read(
        np.stack(chips),
        np.array([edges for _, _, edges, _ in parts], np.float32),
        kind=np.array([kind_index(row["kind"]) for row, *_ in parts]),
        length_px=np.array([box[2] for _, box, _, _ in parts]),
        width_px=np.array([width for *_, width in parts]),
        gsd=np.array(
            [
                known.get(row["file"], _GSD_OF_SET.get(place, np.nan))
                for (row, *_), place in zip(parts, places, strict=True)
            ]
        ),
        place=np.array(places),
        source=np.array([row["file"] for row, *_ in parts]),
        check=np.array([row["use"] == "check" for row, *_ in parts]),
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
    counts = len(read.kind), whole.sum(), (read.kind >= 0).sum(), read.check.sum()
    print("{} cars, {} with all edges, {} of a kind, {} kept back".format(*counts))


if __name__ == "__main__":
    main()
