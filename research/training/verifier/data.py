"""Candidates of a detector at a low threshold on all train images: hits, false alarms, chips."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray

from research.training.detector.data import TrainImage, photometric
from research.training.detector.shade import shaded
from research.training.logistic import weight_of_sets
from vehanchor.detection.boxes import oriented_nms
from vehanchor.detection.detector import Detector
from vehanchor.detection.verifier import CHIP_LENGTH_PX, CHIP_PX, surroundings
from vehanchor.storage.atomic import whole_file

Chips: TypeAlias = NDArray[np.uint8]
"""Chips ``[..., h, w, 3]``."""

Boxes: TypeAlias = NDArray[np.float64]
"""Boxes ``[n, 5]``: x, y, length, width, angle."""

Polygons: TypeAlias = NDArray[np.float64]
"""Corners ``[n, 4, 2]`` of areas."""

# Side of a stored chip, with room for jitter and turns around a chip of 48.
STORED_PX = 72
_CAR_PX = (
    15.0,
    28.0,
    55.0,
    110.0,
)  # sizes at which an image is searched: at the finer ones a car's parts look like cars
# An enlarged image has no parts to learn from.
_MAX_ENLARGEMENT = {15.0: 2.2, 28.0: 2.2, 55.0: 1.1, 110.0: 1.0}
_MIN_SCORE = 0.15
# Random false alarms of an image at one size; a harbour has hundreds.
_MAX_FALSE = 40
# Distances in lengths of a label: beyond the one, within the other.
_NEAR = 0.6
_AT = 0.25
_LENGTH_RATIO = 1.35
# A shorter box on a car, as a share of its length, is a part of it and not a car.
_PART_RATIO = 0.55
# Jitter of position and size, as a share of the length.
_JITTER = 0.06
# Jitter of the angle, radians.
_TURN = 0.08
# Length of the candidate on its chip.
_CANDIDATE = np.array([[CHIP_PX / 2, CHIP_PX / 2, CHIP_LENGTH_PX, 0.45 * CHIP_LENGTH_PX, 0.0]])


class Candidates(NamedTuple):
    """Candidates of a detector.

    Attributes:
        chips: ``[n, 72, 72, 3]`` uint8.
        car: ``[n]`` bool.
        scores: ``[n]`` of the detector.
        sets: ``[n]`` names.
    """

    chips: Chips
    car: NDArray[np.bool_]
    scores: NDArray[np.float64]
    sets: NDArray[np.str_]


def truth_of(boxes: Boxes, labels: Boxes, ignore: Polygons) -> NDArray[np.int8]:
    """Label candidates: 1 hit, 0 false alarm, -1 ignored (on an ignored place or beside a car).

    Args:
        boxes: ``[n, 5]`` found.
        labels: ``[m, 5]`` cars.
        ignore: ``[k, 4, 2]`` corners.
    """
    truth = np.zeros(len(boxes), np.int8)
    if len(labels):
        offsets = boxes[:, None, :2] - labels[None, :, :2]
        gap = np.linalg.norm(offsets, axis=2) / labels[None, :, 2]
        nearest = gap.argmin(axis=1)
        ratio = np.abs(np.log(boxes[:, 2] / labels[nearest, 2]))
        truth[gap.min(axis=1) < _NEAR] = -1
        truth[(gap.min(axis=1) < _AT) & (ratio < np.log(_LENGTH_RATIO))] = 1
        part = boxes[:, 2] < _PART_RATIO * labels[nearest, 2]
        truth[part & (gap.min(axis=1) < 0.5)] = 0
    for polygon in ignore:
        around = polygon.astype(np.float32)
        for k in np.flatnonzero(truth == 0):
            reach = cv2.pointPolygonTest(
                around, (float(boxes[k, 0]), float(boxes[k, 1])), measureDist=True
            )
            if reach > -0.3 * boxes[k, 2]:
                truth[k] = -1
    return truth


def mined(images: Iterable[TrainImage], detector: Detector) -> Candidates:
    """Search images at several sizes and cut what is found."""
    rng = np.random.default_rng(0)
    chips = []
    car = []
    scores = []
    sets = []
    for sample in images:
        native = (
            float(np.median(sample.boxes[:, 2])) if len(sample.boxes) else sample.car_px or 15.0
        )
        for target in _CAR_PX:
            factor = target / native
            if factor > _MAX_ENLARGEMENT[target] or min(sample.image.shape[:2]) * factor < 48:
                continue
            way = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
            scaled = np.asarray(
                cv2.resize(sample.image, None, fx=factor, fy=factor, interpolation=way), np.uint8
            )
            vehicles = detector.detect_tile(detector.prepared(scaled), _MIN_SCORE).vehicles
            survivors = oriented_nms(vehicles.boxes, vehicles.scores)
            boxes = vehicles.boxes[survivors]
            score = vehicles.scores[survivors]
            truth = truth_of(
                boxes, sample.boxes * (factor, factor, factor, factor, 1), sample.ignore * factor
            )
            false = rng.permutation(np.flatnonzero(truth == 0))
            truth[false[_MAX_FALSE:]] = -1
            is_known = truth >= 0
            chips.append(
                surroundings(scaled, boxes[is_known], side_px=STORED_PX, length_px=CHIP_LENGTH_PX)
            )
            car.append(truth[is_known] == 1)
            scores.append(score[is_known])
            sets += [sample.set] * int(is_known.sum())
    return Candidates(
        np.concatenate(chips),
        np.concatenate(car),
        scores=np.concatenate(scores),
        sets=np.array(sets),
    )


def save(candidates: Candidates, path: Path) -> None:
    """Write candidates beside a run."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as partial, partial.open("wb") as handle:
        np.savez(handle, **candidates._asdict())


def load(path: Path) -> Candidates:
    """Read what ``save`` wrote."""
    with np.load(path) as stored:
        return Candidates(**{name: stored[name] for name in Candidates._fields})


def middle(chips: Chips) -> Chips:
    """Cut chips of ``CHIP_PX`` from the middle of stored ones, ``[n, 48, 48, 3]``."""
    margin = (chips.shape[1] - CHIP_PX) // 2
    return chips[:, margin : margin + CHIP_PX, margin : margin + CHIP_PX]


@dataclass
class ChipStream:
    """Endless seeded stream of chips: half cars, half not; sets by the root of their size."""

    candidates: Candidates
    seed: int

    def __post_init__(self) -> None:
        """Weigh the candidates."""
        self._weight = []
        for car in (False, True):
            indices = self.candidates.car == car
            weight = np.zeros(len(self.candidates.car))
            weight[indices] = weight_of_sets(self.candidates.sets[indices])
            self._weight.append(np.cumsum(weight))

    def __getitem__(self, index: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Make a chip ``[3, 48, 48]`` uint8 and whether it is a car, 0 or 1."""
        cv2.setNumThreads(1)
        rng = np.random.default_rng([self.seed, index])
        car = int(rng.random() < 0.5)
        drawn = int(np.searchsorted(self._weight[car], rng.random()))
        last = len(self.candidates.car) - 1
        chip = varied(rng, self.candidates.chips[min(drawn, last)])
        chip = shaded(rng, chip, _CANDIDATE)
        chip = photometric(rng, chip)
        channels = np.ascontiguousarray(chip.transpose(2, 0, 1))
        return torch.from_numpy(channels), torch.tensor(float(car))


def varied(rng: Generator, stored: Chips) -> Chips:
    """Cut a chip of a box a little off, mirrored at random, sometimes of a coarser image."""
    scale = np.exp(rng.normal(0, _JITTER))
    turn = rng.normal(0, _TURN)
    flip = rng.choice((-1.0, 1.0), 2)
    cos = np.cos(turn)
    sin = np.sin(turn)
    rotation = np.array([[cos, -sin], [sin, cos]])
    matrix = rotation * scale * flip[None]
    off = rng.normal(0, _JITTER * CHIP_LENGTH_PX, 2)
    origin = STORED_PX / 2 + off - matrix @ [CHIP_PX / 2, CHIP_PX / 2]
    full = np.column_stack([matrix, origin])
    full[:, 2] += full[:, :2] @ (0.5, 0.5) - 0.5
    cut = cv2.warpAffine(
        stored,
        full,
        (CHIP_PX, CHIP_PX),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    if rng.random() < 0.3:
        small = round(CHIP_PX * rng.uniform(0.45, 0.9))
        coarse = cv2.resize(cut, (small, small), interpolation=cv2.INTER_AREA)
        cut = cv2.resize(coarse, (CHIP_PX, CHIP_PX), interpolation=cv2.INTER_LINEAR)
    return np.asarray(cut, np.uint8)
