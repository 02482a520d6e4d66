"""Correct the train labels with the model itself: ``python -m research.training.detector.relabel MODEL.onnx OUT.csv``.

Every train image of known scale is searched in its eight symmetries, at the size where a car is 26 px long. What most
of them agree on and has a car's size in metres becomes a car where no label is; what is doubtful is ignored, and so is
a label that the model does not see in any symmetry. What has no car's size is listed as clutter: training looks there
more often. The table is text, kept beside this module (``corrections.csv``) and applied by ``data.py``.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from research.training.detector.data import is_dev
from vehanchor.detection.boxes import boxes_from_corners, canonical_boxes
from vehanchor.detection.detector import Detector
from vehanchor.detection.nms import oriented_nms
from vehanchor.storage.atomic import whole_file
from vehanchor_evaluation.dota import read_labels
from vehanchor_evaluation.table import read_table

_SEARCH_SCORE = 0.15
_CAR_PX, _CAR_M = 26.0, 4.5
_LENGTHS_M, _WIDTHS_M = (3.0, 6.4), (1.25, 2.95)
_SURE, _DOUBTFUL, _CLUTTER, _UNSEEN = 0.55, 0.30, 0.25, 0.08  # mean score over the eight symmetries
_SAME_PLACE = 0.35  # of a length
_IOU = 0.3
_N_SYMMETRIES = 8


KINDS = ("car", "ignore", "clutter", "unseen")


class Consensus(NamedTuple):
    """Merged detections of all symmetries: ``boxes`` ``[n, 5]`` in image pixels and mean ``scores`` ``[n]``."""

    boxes: NDArray[np.float64]
    scores: NDArray[np.float64]


def corrections(
    found: Consensus, cars: NDArray[np.float64], ignored: NDArray[np.float64], gsd_m_per_px: float
) -> list[tuple[str, NDArray[np.float64], float]]:
    """List the changes to an image's labels: kind, box and mean score of each.

    Args:
        found: what the symmetries agree on.
        cars: ``[n, 5]`` labelled cars.
        ignored: ``[m, 5]`` labelled trucks and doubtful places.
        gsd_m_per_px: the true scale.
    """
    metres = found.boxes[:, 2:4] * gsd_m_per_px
    car_sized: NDArray[np.bool_] = np.all(
        (metres > (_LENGTHS_M[0], _WIDTHS_M[0])) & (metres < (_LENGTHS_M[1], _WIDTHS_M[1])), axis=1
    )
    free = (nearest_gap(found.boxes, cars) > _SAME_PLACE) & (nearest_gap(found.boxes, ignored) > 0.5)
    out = []
    for box, score, sized, new in zip(found.boxes, found.scores, car_sized, free, strict=True):
        if not new:
            continue
        if sized and score >= _SURE:
            out.append(("car", box, float(score)))
        elif sized and score >= _DOUBTFUL:
            out.append(("ignore", box, float(score)))
        elif not sized and score >= _CLUTTER:
            out.append(("clutter", box, float(score)))
    seen = found.boxes[found.scores >= _UNSEEN]
    out += [("unseen", box, 0.0) for box in cars[nearest_gap(cars, seen) > 0.5]]
    return out


def symmetric(image: NDArray[np.uint8], k: int) -> NDArray[np.uint8]:
    """The image turned by ``k % 4`` right angles, mirrored before that for ``k >= 4``."""
    return np.ascontiguousarray(np.rot90(image[:, ::-1] if k >= 4 else image, k % 4))


def restored(boxes: NDArray[np.float64], k: int, width: int, height: int) -> NDArray[np.float64]:
    """Boxes of ``symmetric(image, k)`` in the pixels of the image, which is ``width`` x ``height``."""
    x, y, length, breadth, angle = boxes.T
    for turn in reversed(range(k % 4)):  # rot90 takes (x, y) to (y, side - x), side being the width before the turn
        side = height if turn % 2 else width
        x, y, angle = side - y, x, angle + np.pi / 2
    if k >= 4:
        x, angle = width - x, -angle
    return canonical_boxes(np.column_stack([x, y, length, breadth, angle]))


def search(image: NDArray[np.uint8], gsd_m_per_px: float, detector: Detector) -> Consensus:
    """Detections that the symmetries of an image share, each with its mean score over all of them."""
    factor = gsd_m_per_px * _CAR_PX / _CAR_M
    way = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    scaled = np.asarray(cv2.resize(image, None, fx=factor, fy=factor, interpolation=way), np.uint8)
    height, width = scaled.shape[:2]
    boxes, scores, views = [], [], []
    for k in range(_N_SYMMETRIES):
        seen = detector.detect_tile(detector.prepared(symmetric(scaled, k)), _SEARCH_SCORE).vehicles
        score, kept = seen.scores, oriented_nms(seen.boxes, seen.scores, iou_threshold=_IOU)
        box = restored(seen.boxes, k, width, height)
        boxes.append(box[kept])
        scores.append(score[kept])
        views.append(np.full(len(kept), k))
    merged = agree(np.concatenate(boxes), np.concatenate(scores), np.concatenate(views))
    return Consensus(merged.boxes / (factor, factor, factor, factor, 1.0), merged.scores)


def agree(boxes: NDArray[np.float64], scores: NDArray[np.float64], views: NDArray[np.intp]) -> Consensus:
    """Merge boxes of several views that lie at one place: the median box, the mean score over all views."""
    order = np.argsort(-scores, kind="stable")
    boxes, scores, views = boxes[order], scores[order], views[order]
    free = np.ones(len(boxes), bool)
    out, mean = [], []
    for i in range(len(boxes)):
        if not free[i]:
            continue
        gap = np.linalg.norm(boxes[:, :2] - boxes[i, :2], axis=1)
        members = np.flatnonzero(free & (gap < _SAME_PLACE * boxes[i, 2]))
        _, first = np.unique(views[members], return_index=True)  # the best of each view
        members = members[first]
        free[gap < _SAME_PLACE * boxes[i, 2]] = False
        twice = 2 * boxes[members, 4]
        angle = 0.5 * np.arctan2((scores[members] * np.sin(twice)).sum(), (scores[members] * np.cos(twice)).sum())
        out.append([*np.median(boxes[members, :4], axis=0), angle])
        mean.append(scores[members].sum() / _N_SYMMETRIES)
    return Consensus(canonical_boxes(np.array(out).reshape(-1, 5)), np.array(mean))


def nearest_gap(boxes: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """For each box the distance to the nearest centre of the others, in lengths of that other; infinite for none."""
    if not len(others):
        return np.full(len(boxes), np.inf)
    gap = np.linalg.norm(boxes[:, None, :2] - others[None, :, :2], axis=2) / others[None, :, 2]
    return np.asarray(gap.min(axis=1))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    options = parser.parse_args()
    detector = Detector(options.model)
    counts = dict.fromkeys(KINDS, 0)
    with whole_file(options.out) as partial, partial.open("w", newline="") as handle:
        table = csv.writer(handle)
        table.writerow(("file", "kind", "x", "y", "length", "width", "angle", "score"))
        for item in read_table(options.data / "gsd" / "table.csv"):
            if item.split != "train" or is_dev(item.path.name, item.set):
                continue
            image = cv2.imread(str(item.path))
            assert image is not None
            rgb = np.ascontiguousarray(image[:, :, ::-1]).astype(np.uint8)
            found = search(rgb, item.gsd_m_per_px, detector)
            labels = read_labels(options.data / "vehicles" / "labels" / f"{item.path.stem}.txt")
            for kind, box, score in corrections(
                found,
                boxes_from_corners(labels.of_class("small-vehicle")),
                boxes_from_corners(labels.of_class("large-vehicle", "ignore")),
                item.gsd_m_per_px,
            ):
                table.writerow((item.path.name, kind, *(f"{v:.1f}" for v in box[:4]), f"{box[4]:.3f}", f"{score:.2f}"))
                counts[kind] += 1
    print(counts)


if __name__ == "__main__":
    main()
