"""Labels for images of known scale without oriented boxes, by size and by human judgement.

``python -m research.training.detector.scenery MODEL.onnx OUT.csv`` searches each image in its eight symmetries
(``relabel.search``) and writes ``scenery.csv``: cars to learn, places to ignore, clutter to look at more often. All
other ground is background. Three judges, in this order:

* people: in ``estonia`` every box drawn by people is a car, turned as the detector sees it; in ``looked_at.csv`` stands
  what we made of candidates on contact sheets;
* size: what has no car's size in metres at the known scale is none, however much it looks like one;
* the detector, by the mean score over the symmetries, where the kind of place allows cars at all: boats in a harbour
  outnumber its cars by a hundred to one, so nothing there is learned as a car.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from research.training.detector.data import TrainImage, corrected, read_corrections
from research.training.detector.places import Place, is_held_out, looked_at, places
from research.training.detector.relabel import Consensus, search
from vehanchor.detection.detector import Detector
from vehanchor.storage.atomic import whole_file
from vehanchor_evaluation.dota import read_labels

SCENERY = Path(__file__).with_name("scenery.csv")
CAR_M = 4.5
_LENGTHS_M, _WIDTHS_M = (3.0, 6.4), (1.25, 2.95)
_SEEN = 0.2  # mean score over the symmetries below which nothing is written down
_SAME_PLACE_M = 1.5


@dataclass(frozen=True)
class Policy:
    """Score limits of car-sized objects: car above the first, undecided above the second, else clutter."""

    car: float
    ignore: float


_NEVER = Policy(car=2.0, ignore=2.0)
_POLICY = {
    "harbor": _NEVER,
    "estonia_port": _NEVER,  # every candidate was looked at
    "airplane": Policy(2.0, 0.3),  # aprons are full of carts and tugs
    "runway": Policy(2.0, 0.3),
    "baseballdiamond": _NEVER,  # every candidate was looked at: benches, stands, dugouts
    "overpass": Policy(0.5, 0.3),
    "tenniscourt": Policy(0.6, 0.3),
    "sparseresidential": Policy(0.6, 0.3),
    "storagetanks": Policy(0.6, 0.3),
    "building": Policy(0.7, 0.5),
    "garfield": Policy(0.6, 0.5),
    "seneca": Policy(0.6, 0.5),
    "estonia": _NEVER,  # people drew all cars
}


def judged(
    found: Consensus, policy: Policy, gsd_m_per_px: float, looked_at: Sequence[tuple[float, float, str]]
) -> list[tuple[str, NDArray[np.float64], float]]:
    """Kind, box and mean score of what the symmetries found.

    Args:
        found: boxes in image pixels and their mean scores.
        policy: of the kind of place.
        gsd_m_per_px: the true scale.
        looked_at: x, y and kind of the candidates that were looked at; they are no more the detector's to judge.
    """
    out = []
    for box, score in zip(found.boxes, found.scores, strict=True):
        if score < _SEEN:
            continue
        length, width = box[2:4] * gsd_m_per_px
        sized = _LENGTHS_M[0] < length < _LENGTHS_M[1] and _WIDTHS_M[0] < width < _WIDTHS_M[1]
        told = _told(box, gsd_m_per_px, looked_at)
        if told:
            kind = told
        elif sized and score >= policy.car:
            kind = "car"
        elif sized and score >= policy.ignore:
            kind = "ignore"
        else:
            kind = "clutter"
        out.append((kind, box, float(score)))
    return out


def turned(
    found: Consensus,
    upright: NDArray[np.float64],
    gsd_m_per_px: float,
    looked_at: Sequence[tuple[float, float, str]] = (),
) -> list[tuple[str, NDArray[np.float64], float]]:
    """People's upright boxes as oriented ones, and everything else that the symmetries found as clutter.

    A detection stands for a person's box when its centre lies in the box grown by a tenth and its length between 0.6
    of the longer side and 1.25 of the diagonal. A box without one that is clearly longer one way is its own axis; the
    others, a car that nobody saw the axis of, are ignored.

    Args:
        found: boxes in image pixels and their mean scores.
        upright: ``[n, 4, 2]`` corners of people's boxes.
        gsd_m_per_px: the true scale.
        looked_at: x, y and kind of candidates that were looked at: cars that people overlooked.
    """
    out, taken = [], np.zeros(len(found.boxes), bool)
    low, high = upright.min(axis=1), upright.max(axis=1)
    for side, middle in zip(high - low, (low + high) / 2, strict=True):
        inside = (np.abs(found.boxes[:, :2] - middle) < 0.55 * side).all(axis=1)
        long = (found.boxes[:, 2] > 0.6 * side.max()) & (found.boxes[:, 2] < 1.25 * np.hypot(*side))
        taken |= (np.abs(found.boxes[:, :2] - middle) < 0.75 * side).all(axis=1)
        metres = found.boxes[:, 2] * gsd_m_per_px
        fitting = np.flatnonzero(inside & long & (found.scores > 0.1) & (metres > 3.0) & (metres < 6.8))
        if len(fitting):
            best = fitting[found.scores[fitting].argmax()]
            out.append(("car", found.boxes[best], float(found.scores[best])))
        elif side.max() > 1.7 * side.min():
            angle = 0.0 if side[0] > side[1] else np.pi / 2
            out.append(("car", np.array([*middle, side.max(), side.min(), angle]), 0.0))
        else:
            out.append(("ignore", np.array([*middle, side.max(), side.min(), 0.0]), 0.0))
    for box, score in zip(found.boxes[~taken], found.scores[~taken], strict=True):
        if score >= _SEEN:
            out.append((_told(box, gsd_m_per_px, looked_at) or "clutter", box, float(score)))
    return out


def _told(box: NDArray[np.float64], gsd_m_per_px: float, looked_at: Sequence[tuple[float, float, str]]) -> str | None:
    near = (kind for x, y, kind in looked_at if np.hypot(x - box[0], y - box[1]) * gsd_m_per_px < _SAME_PLACE_M)
    return next(near, None)


def load_scenery(data: Path, table: Path = SCENERY, *, held_out: bool = False) -> list[TrainImage]:
    """Load the places that train, with what ``scenery.csv`` says; lorries drawn by people are ignored."""
    known, out = read_corrections(table), []
    for place in places(data):
        if is_held_out(place) != held_out:
            continue
        image = cv2.imread(str(place.path), cv2.IMREAD_COLOR)
        if image is None:
            raise FileNotFoundError(place.path)
        lorries = np.zeros((0, 4, 2))
        if place.labels:
            lorries = read_labels(place.labels).of_class("large-vehicle")
        bare = TrainImage(
            place.kind if place.kind == "harbor" else place.set,
            np.ascontiguousarray(image[:, :, ::-1]).astype(np.uint8),
            np.zeros((0, 5)),
            lorries,
            np.zeros((0, 2)),
            CAR_M / place.gsd_m_per_px,
        )
        out.append(corrected(bare, known.get(place.path.name, [])))
    return out


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument(
        "--found", type=Path, help="folder that keeps what was found, to be judged again without a search"
    )
    options = parser.parse_args()
    detector = Detector(options.model)
    seen = looked_at()
    counts: dict[str, int] = {}
    with whole_file(options.out) as partial, partial.open("w", newline="") as handle:
        table = csv.writer(handle)
        table.writerow(("file", "kind", "x", "y", "length", "width", "angle", "score"))
        for place in places(options.data):
            found = _searched(place, detector, options.found)
            known = seen.get(place.path.name, [])
            if place.set == "estonia":
                assert place.labels is not None
                rows = turned(found, read_labels(place.labels).of_class("small-vehicle"), place.gsd_m_per_px, known)
            else:
                rows = judged(found, _POLICY[place.kind], place.gsd_m_per_px, known)
            for kind, box, score in rows:
                table.writerow((place.path.name, kind, *(f"{v:.1f}" for v in box[:4]), f"{box[4]:.3f}", f"{score:.2f}"))
                counts[f"{place.set} {kind}"] = counts.get(f"{place.set} {kind}", 0) + 1
    print(counts)


def _searched(place: Place, detector: Detector, kept: Path | None) -> Consensus:
    file = kept / f"{place.path.stem}.npz" if kept else None
    if file and file.exists():
        with np.load(file) as stored:
            return Consensus(stored["boxes"], stored["scores"])
    image = cv2.imread(str(place.path), cv2.IMREAD_COLOR)
    if image is None:
        raise FileNotFoundError(place.path)
    found = search(np.ascontiguousarray(image[:, :, ::-1]).astype(np.uint8), place.gsd_m_per_px, detector)
    if file:
        file.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(file) as partial, partial.open("wb") as handle:
            np.savez(handle, boxes=found.boxes, scores=found.scores)
    return found


if __name__ == "__main__":
    main()
