"""Candidates for readings: ``python -m research.training.readings.candidates OUT.csv``.

Labels give the cars of the train images; the bundled detector gives those of the sets that nobody has labelled.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from research.training.detector.data import read_corrections
from research.training.detector.places import places
from research.training.detector.scenery import SCENERY
from vehanchor import Engine, Runtime
from vehanchor.detection.boxes import boxes_from_corners
from vehanchor_evaluation.dota import read_labels

_LEAST_SCORE = 0.25
_SHARP = ("jekhor_DJI", "jekhor_Munich")  # its sharper photographs: the detector's box is wanted beside the reading


class Candidate(NamedTuple):
    """One car's box, in pixels and radians of its image; ``file`` is relative to the folder of data."""

    file: str
    place: str
    x: float
    y: float
    length: float
    width: float
    angle: float
    score: float  # 1 for a label

    @property
    def box(self) -> NDArray[np.float64]:
        """``[5]`` x, y, length, width, angle."""
        return np.asarray(self[2:7], np.float64)


def _candidates(file: str, place: str, boxes: NDArray[np.float64], scores: NDArray[np.float64]) -> Iterator[Candidate]:
    for box, score in zip(boxes, scores, strict=True):
        x, y, length, width = (round(float(value), 2) for value in box[:4])
        yield Candidate(file, place, x, y, length, width, round(float(box[4]), 4), round(float(score), 3))


def labelled(data: Path) -> Iterator[Candidate]:
    """Labels of the train images of ``vehicles``, and those of Estonia as the detector turned them."""
    with (data / "vehicles" / "index.csv").open(newline="") as handle:
        rows = [row for row in csv.DictReader(handle) if row["split"] == "train"]
    for row in rows:
        text = data / "vehicles" / "labels" / f"{Path(row['file']).stem}.txt"
        if row["set"] != "empty" and text.exists():
            boxes = boxes_from_corners(read_labels(text).of_class("small-vehicle", "large-vehicle"))
            yield from _candidates(f"vehicles/{row['file']}", row["set"], boxes, np.ones(len(boxes)))
    turned = read_corrections(SCENERY)
    for place in places(data):
        if place.set == "estonia":
            boxes = np.asarray([c.box for c in turned.get(place.path.name, []) if c.kind == "car"]).reshape(-1, 5)
            yield from _candidates(place.path.relative_to(data).as_posix(), "estonia", boxes, np.ones(len(boxes)))


def unlabelled(data: Path) -> Iterator[tuple[Path, str]]:
    """Photographs for the detector, and their places: fleets, odd crops of chia, garfield, sharp jekhor."""
    for path in sorted((data / "fleets").glob("*/*.jpg")):
        yield path, path.parent.name
    for path in sorted((data / "chia" / "crops").glob("*.jpg")):
        if int(path.stem[-1]) % 2:
            yield path, "chia"
    for path in sorted((data / "flights" / "garfield").glob("*.jpg")):
        yield path, "garfield"
    with (data / "vehicles" / "index.csv").open(newline="") as handle:
        for row in csv.DictReader(handle):
            if row["split"] == "train" and Path(row["file"]).name.startswith(_SHARP):
                yield data / "vehicles" / row["file"], "jekhor_found"


def read_candidates(path: Path) -> list[Candidate]:
    """Read the table that ``main`` writes."""
    with path.open(newline="") as handle:
        rows = list(csv.reader(handle))[1:]
    return [Candidate(row[0], row[1], *(float(cell) for cell in row[2:])) for row in rows]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    options = parser.parse_args()
    engine = Engine(runtime=Runtime(threads=1))
    with options.out.open("w", newline="") as handle:
        writer = csv.writer(handle)
        writer.writerow(Candidate._fields)
        writer.writerows(labelled(options.data))
        for path, place in unlabelled(options.data):
            found = engine.analyse_scale(path).detections
            keep = found.scores >= _LEAST_SCORE
            file = path.relative_to(options.data).as_posix()
            writer.writerows(_candidates(file, place, found.boxes[keep], found.scores[keep]))
            handle.flush()
            print(file, int(keep.sum()), flush=True)


if __name__ == "__main__":
    main()
