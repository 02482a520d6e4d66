"""Draw contact sheets of fifty false alarms and fifty misses.

``python -m research.benchmarks.failure_sheets OUT [--set estonia]``.

Writes ``OUT/false_alarms.png`` and ``OUT/misses.png`` of a val set with people's boxes: labels green, the box of the
detector red with its score. False alarms are every other one of the surest hundred; misses are drawn by lot, with the
best box below the threshold, if there is one.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from research.benchmarks.regression_sets import DATA, Sighted, hit_labels, people_images, sighted
from vehanchor.detection.boxes import box_corners
from vehanchor.detection.detector import Detector
from vehanchor.models.zoo import resolve_model
from vehanchor_evaluation.dota import read_labels

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

_COLUMNS, _ROWS = 10, 5
_HALF_PX, _ENLARGED = 24, 5
_RED, _GREEN, _YELLOW = (0, 0, 255), (0, 255, 0), (0, 255, 255)


class Failure(NamedTuple):
    """A false alarm or a miss.

    Attributes:
        score: of the box; 0 without one.
        image: the file.
        centre: ``[2]`` pixels.
        box: ``[5]`` the detector's; None without one.
        labels: ``[m, 4, 2]`` corners of the people's.
    """

    score: float
    image: Path
    centre: NDArray[np.float64]
    box: NDArray[np.float64] | None
    labels: NDArray[np.float64]


def failures(path: Path, found: Sighted, min_score: float) -> tuple[list[Failure], list[Failure]]:
    """False alarms and misses of one image."""
    sure = found.above(min_score)
    hits = hit_labels(sure.boxes, found.labels)
    false = [
        Failure(float(sure.scores[k]), path, sure.boxes[k, :2], sure.boxes[k], found.labels)
        for k in np.flatnonzero(hits < 0)
    ]
    doubtful = hit_labels(found.boxes, found.labels)
    missed = []
    for label in sorted(set(range(len(found.labels))) - set(hits.tolist())):
        best = np.flatnonzero(doubtful == label)[:1]
        score, box = (float(found.scores[best[0]]), found.boxes[best[0]]) if len(best) else (0.0, None)
        corners = found.labels[label]
        missed.append(Failure(score, path, corners.mean(axis=0), box, corners[None]))
    return false, missed


def drawn(failure: Failure) -> NDArray[np.uint8]:
    """The place with its boxes, enlarged."""
    image = cv2.imread(str(failure.image), cv2.IMREAD_COLOR)
    if image is None:
        raise FileNotFoundError(failure.image)
    corner = np.round(failure.centre).astype(int) - _HALF_PX
    around = cv2.copyMakeBorder(image, *(_HALF_PX,) * 4, cv2.BORDER_CONSTANT)
    side = 2 * _HALF_PX
    part = around[corner[1] + _HALF_PX :, corner[0] + _HALF_PX :][:side, :side]
    picture = np.asarray(cv2.resize(part, None, fx=_ENLARGED, fy=_ENLARGED, interpolation=cv2.INTER_CUBIC), np.uint8)
    outlines = [(label, _GREEN) for label in failure.labels]
    if failure.box is not None:
        outlines.append((box_corners(failure.box[None])[0], _RED))
    for corners, colour in outlines:
        cv2.polylines(picture, [np.round((corners - corner) * _ENLARGED).astype(np.int32)], True, colour, 1)
    cv2.putText(picture, f"{failure.score:.2f}", (3, 14), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _YELLOW, 1)
    return picture


def sheet(chosen: Iterable[Failure]) -> NDArray[np.uint8]:
    """Pictures in rows of ten."""
    tiles = [drawn(failure) for failure in chosen]
    tiles += [np.zeros_like(tiles[0])] * (-len(tiles) % _COLUMNS)
    return np.vstack([np.hstack(tiles[start : start + _COLUMNS]) for start in range(0, len(tiles), _COLUMNS)])


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--set", default="estonia")
    parser.add_argument("--detector")
    options = parser.parse_args()
    detector = Detector(resolve_model(options.detector))
    false, missed = [], []
    for name, path, labels in people_images(DATA, held_out=False):
        if name.startswith(options.set):
            found = sighted(path, detector)._replace(labels=read_labels(labels).of_class("small-vehicle"))
            more_false, more_missed = failures(path, found, detector.card.min_score)
            false += more_false
            missed += more_missed
    false.sort(key=lambda failure: -failure.score)
    number = _COLUMNS * _ROWS
    lot = np.random.default_rng(0).permutation(len(missed))[:number]
    options.out.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(options.out / "false_alarms.png"), sheet(false[: 2 * number : 2] if len(false) > number else false))
    cv2.imwrite(str(options.out / "misses.png"), sheet(missed[k] for k in lot))
    print(f"{options.set}: {len(false)} false alarms, {len(missed)} misses")


if __name__ == "__main__":
    main()
