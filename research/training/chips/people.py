"""Collect candidates on photographs whose cars people have drawn.

``python -m research.training.chips.people R``.

Writes the store ``R/people``, which trains nothing: val of Estonia, street crossings, ``harlem``
and the even crops of ``chia``. Boxes of the first two are upright: a candidate is a car if its
upright box overlaps one by half. What lies on doubtful things, at the image's edge, or overlaps a
little counts neither way.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from research.training.chips.mine import LOOKED_AT
from research.training.chips.store import STORED_LENGTH_PX, STORED_PX, ChipStore, Rows
from vehanchor.detection.boxes import box_corners
from vehanchor.detection.detections import Objects
from vehanchor.detection.detector import Detector
from vehanchor.detection.search import ImageSearch
from vehanchor.detection.verifier import surroundings
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import resolve_model
from vehanchor.options import Search
from vehanchor_evaluation.dota import read_labels

Upright: TypeAlias = NDArray[np.float64]
"""Upright boxes ``[n, 4]``: left, top, right, bottom."""

Corners: TypeAlias = NDArray[np.float64]
"""Corners ``[n, 4, 2]`` of boxes."""

ByEye: TypeAlias = dict[str, list[tuple[str, NDArray[np.float64]]]]
"""Kind and upright box of the objects judged by eye, by file."""

_FITS = 0.5
_MISSES = 0.15
# Least score of the detector.
_MIN_SCORE = 0.15
# Nearer to the image's edge than this many lengths, a candidate counts neither way.
_EDGE = 0.6
_NEAR = 0.5


class Drawn(NamedTuple):
    """Photograph with upright boxes ``[n, 4]`` (left, top, right, bottom) of cars and doubts."""

    path: Path
    set: str
    cars: Upright
    doubtful: Upright


def upright(corners: Corners) -> Upright:
    """Upright boxes ``[n, 4]`` around corners ``[n, 4, 2]``."""
    upper_left = corners.min(axis=1)
    lower_right = corners.max(axis=1)
    return np.concatenate([upper_left, lower_right], axis=1).reshape(-1, 4)


def overlap(first: Upright, second: Upright) -> NDArray[np.float64]:
    """IoU ``[n, m]`` of upright boxes."""
    lower_right = np.minimum(first[:, None, 2:], second[None, :, 2:])
    upper_left = np.maximum(first[:, None, :2], second[None, :, :2])
    size = lower_right - upper_left
    both = np.prod(np.clip(size, 0, None), axis=2)
    first_areas = np.prod(first[:, 2:] - first[:, :2], axis=1)
    second_areas = np.prod(second[:, 2:] - second[:, :2], axis=1)
    either = first_areas[:, None] + second_areas[None, :] - both
    return np.asarray(both / np.maximum(either, 1e-9))


def _looked_at() -> ByEye:
    out: ByEye = {}
    with LOOKED_AT.open(newline="") as handle:
        for row in csv.DictReader(handle):
            x = float(row["x"])
            y = float(row["y"])
            half = 0.35 * float(row["length"])
            square = np.array([x - half, y - half, x + half, y + half])
            out.setdefault(row["file"], []).append((row["kind"], square))
    return out


def photographs(data: Path) -> Iterator[Drawn]:
    """List all photographs."""
    by_eye = _looked_at()
    for folder, sets in (("upright", ("estonia", "crossings")), ("vehicles", ("jekhor",))):
        with (data / folder / "index.csv").open(newline="") as handle:
            val = [row for row in csv.DictReader(handle) if row["split"] == "val"]
        rows = [row for row in val if row["set"] in sets]
        for row in rows:
            file = Path(row["file"])
            labels = read_labels(data / folder / "labels" / f"{file.stem}.txt")
            cars = upright(labels.of_class("small-vehicle").reshape(-1, 4, 2))
            ignored = upright(labels.of_class("ignore").reshape(-1, 4, 2))
            more = [box for kind, box in by_eye.get(file.name, []) if kind != "other"]
            doubtful = np.concatenate([ignored, np.reshape(more, (-1, 4))])
            yield Drawn(data / folder / row["file"], row["set"], cars=cars, doubtful=doubtful)
    with (data / "chia" / "crops.csv").open(newline="") as handle:
        rows = [row for row in csv.DictReader(handle) if _number(row["file"]) % 2 == 0]
    for row in rows:
        there = by_eye.get(Path(row["file"]).name, [])
        parts = [
            np.reshape([box for kind, box in there if (kind == "car") == car], (-1, 4))
            for car in (True, False)
        ]
        yield Drawn(data / "chia" / row["file"], "chia", *parts)


def _number(file: str) -> int:
    """Read the number at the end of a file's name."""
    return int(Path(file).stem[-4:])


def judged(boxes: NDArray[np.float64], drawn: Drawn, size: tuple[int, int]) -> NDArray[np.int8]:
    """1 for a car, 0 for none, -1 where it does not count."""
    around = upright(box_corners(boxes))
    iou = np.zeros(len(boxes))
    if len(drawn.cars):
        iou = overlap(around, drawn.cars).max(axis=1, initial=0.0)
    not_fitting = np.where(iou < _MISSES, 0, -1)
    truth = np.where(iou >= _FITS, 1, not_fitting).astype(np.int8)
    # In this set, the boxes are squares about the centres of cars.
    if drawn.set == "chia" and len(drawn.cars):
        truth = _judged_by_squares(boxes, drawn.cars)
    x = boxes[:, 0]
    y = boxes[:, 1]
    for left, top, right, bottom in drawn.doubtful:
        is_inside = (x > left) & (x < right) & (y > top) & (y < bottom)
        truth[is_inside & (truth == 0)] = -1
    centres = boxes[:, :2]
    gap = np.minimum(centres, np.array(size) - centres).min(axis=1)
    is_at_edge = gap < _EDGE * boxes[:, 2]
    truth[is_at_edge & (truth == 0)] = -1
    return truth


def _judged_by_squares(boxes: NDArray[np.float64], squares: Upright) -> NDArray[np.int8]:
    """Judge boxes ``[n, 5]`` by squares about the centres of cars; see ``judged``."""
    centres = (squares[None, :, :2] + squares[None, :, 2:]) / 2
    gap = np.abs(boxes[:, None, :2] - centres).max(axis=2)
    length = (squares[:, 2] - squares[:, 0]) / 0.7
    log_ratio = np.abs(np.log(boxes[:, None, 2] / length))
    fits = (gap < 0.2 * length) & (log_ratio < 0.25)
    near = gap < _NEAR * length
    not_fitting = np.where(near.any(axis=1), -1, 0)
    return np.where(fits.any(axis=1), 1, not_fitting).astype(np.int8)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    options = parser.parse_args()
    cv2.setNumThreads(1)
    detector = Detector(resolve_model(), runtime=Runtime(threads=1))
    verifier = detector.verifier
    detector.verifier = None
    detector.chips = None
    assert verifier is not None
    store = ChipStore()
    for drawn in photographs(options.data):
        image = cv2.imread(str(drawn.path), cv2.IMREAD_COLOR)
        if image is None:
            raise FileNotFoundError(drawn.path)
        pixels = np.ascontiguousarray(image[:, :, ::-1]).astype(np.uint8)
        with open_raster(pixels) as raster:
            vehicles = ImageSearch(raster, detector, Search(min_score=_MIN_SCORE)).searched()
        boxes = vehicles.boxes
        scores = vehicles.scores
        if not len(boxes):
            continue
        combined = verifier.scored(
            pixels, Objects(boxes, scores, np.zeros(len(boxes), np.intp))
        ).scores
        truth = judged(boxes, drawn, (pixels.shape[1], pixels.shape[0]))
        counted = truth >= 0
        boxes = boxes[counted]
        scores = scores[counted]
        combined = combined[counted]
        truth = truth[counted]
        rows = Rows.unlabelled(boxes[:, 2], drawn.set, drawn.path.name)._replace(
            car=truth, score=scores.astype(np.float32), combined=combined.astype(np.float32)
        )
        store.add(surroundings(pixels, boxes, side_px=STORED_PX, length_px=STORED_LENGTH_PX), rows)
        print(
            drawn.path.name,
            len(drawn.cars),
            int((truth == 1).sum()),
            int((truth == 0).sum()),
            flush=True,
        )
    rows = store.save(options.run / "people")
    for name in np.unique(rows.sets):
        cars = rows.car[rows.sets == name] == 1
        print(f"{name}: {cars.sum()} cars, {(~cars).sum()} others")


if __name__ == "__main__":
    main()
