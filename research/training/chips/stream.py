"""Endless stream of chips from stores and readings, with random geometry, sharpness and colour."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, TypeAlias

import cv2
import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor

from research.training.chips.kinds import BODY_M, CARS, UNKNOWN
from research.training.chips.readings import READ_LENGTH_PX, Read
from research.training.chips.store import STORED_LENGTH_PX, Rows, read_store
from research.training.detector.data import photometric
from research.training.detector.shade import shaded
from research.training.logistic import weight_of_sets
from vehanchor.detection.chips import CHIP_COLUMNS, CHIP_LENGTH_PX, CHIP_ROWS, KINDS

Chip: TypeAlias = NDArray[np.uint8]
"""Chip ``[h, w, 3]``."""

Point: TypeAlias = NDArray[np.float64]
"""Point or direction ``[2]``."""

Matrix: TypeAlias = NDArray[np.float64]
"""Matrix ``[2, 2]``."""

# Standard deviations of a candidate's shift in lengths, log scale, and turn in radians.
_SHIFT = 0.06
_SCALE = 0.08
_TURN = 0.07
# Largest of these in standard deviations; a car's box still fits there.
_MAX_SD = 2.2
_COARSE_SHARE = 0.45
_COARSEST_PX = 10.0
_CANDIDATE = np.array(
    [[CHIP_COLUMNS / 2, CHIP_ROWS / 2, CHIP_LENGTH_PX, 0.45 * CHIP_LENGTH_PX, 0.0]]
)
# Shares of candidates, of readings of ends and sides, and of readings of kinds alone.
_SHARES = (0.68, 0.18, 0.14)
_CAR_SHARE = 0.5
_RENDERED = ("scene", "pasted")
_RENDERED_WEIGHT = 0.25
# Weight of a length in metres that a box gives.
_BOX_WEIGHT = 0.3
# Weight of a length or width that a first network measured, times its own weight.
_MEASURED_WEIGHT = 0.8
# Longest small two-box car; at an unknown scale, readings call all of these compact.
_LONGEST_SMALL_M = 3.9
_MEASURED_BY_EYE = ("mashiki", "fuji", "bergamo", "garfield")
# Weight of the size of a kind where the scale is unknown.
_TABLE_WEIGHT = 0.2
# Any kind that is not a car.
NOT_A_CAR = -2


class Batch(NamedTuple):
    """Example or batch: a chip and its targets; unknown ones are NaN or -1, or have weight 0.

    Attributes:
        chip: ``[3, 64, 96]`` uint8.
        car: 1, 0 or NaN.
        kind: index into ``KINDS``; -1 for unknown, -2 for any kind that is not a car.
        kind_weight: weight of the kind.
        edges: ``[4]`` in candidate lengths.
        turn: radians.
        edge_weight: weight of edges and turn.
        log_metres: ``[2]`` logs of length and width.
        metres_weight: ``[2]`` weights of length and width.
    """

    chip: Tensor
    car: Tensor
    kind: Tensor
    kind_weight: Tensor
    edges: Tensor
    turn: Tensor
    edge_weight: Tensor
    log_metres: Tensor
    metres_weight: Tensor


class Move(NamedTuple):
    """Map from a chip to the stored one that it is cut from, in lengths.

    ``stored = shift + scale * rotation(turn) @ (flip * chip)``.
    """

    shift: Point
    scale: float
    turn: float
    flip: Point

    @property
    def matrix(self) -> Matrix:
        """Matrix ``[2, 2]`` from the chip to the stored chip."""
        cos = np.cos(self.turn)
        sin = np.sin(self.turn)
        rotation = np.array([[cos, -sin], [sin, cos]])
        return np.asarray(self.scale * rotation * self.flip[None])


STILL = Move(np.zeros(2), 1.0, turn=0.0, flip=np.ones(2))


def draw_move(rng: Generator) -> Move:
    """Draw a small displacement of a candidate, mirrored at random."""
    shift = np.clip(rng.normal(0, 1, 2), -_MAX_SD, _MAX_SD)
    scale = np.clip(rng.normal(0, 1, 1), -_MAX_SD, _MAX_SD)
    turn = np.clip(rng.normal(0, 1, 1), -_MAX_SD, _MAX_SD)
    return Move(
        _SHIFT * shift,
        float(np.exp(_SCALE * scale[0])),
        turn=float(_TURN * turn[0]),
        flip=rng.choice((-1.0, 1.0), 2),
    )


def cut(stored: Chip, length_px: float, move: Move = STILL) -> Chip:
    """Cut a chip ``[64, 96, 3]`` from a stored square whose candidate is ``length_px`` long."""
    matrix = move.matrix * (length_px / CHIP_LENGTH_PX)
    middle = np.array([CHIP_COLUMNS, CHIP_ROWS]) / 2
    origin = stored.shape[0] / 2 + move.shift * length_px - matrix @ middle
    full = np.column_stack([matrix, origin])
    # Continuous coordinates have pixel centres at +0.5.
    full[:, 2] += full[:, :2] @ (0.5, 0.5) - 0.5
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = (CHIP_COLUMNS, CHIP_ROWS)
    chip = cv2.warpAffine(stored, full, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(chip, np.uint8)


def moved_edges(
    edges: NDArray[np.floating], turn: float, move: Move
) -> tuple[NDArray[np.float32], float]:
    """Compute edges and turn of a body in the moved chip.

    The first end is the left one, and the first side is the upper one.
    """
    cos = np.cos(turn)
    sin = np.sin(turn)
    axes = np.array([[cos, sin], [-sin, cos]])
    moved = np.empty(4, np.float32)
    moved_axes = axes @ move.matrix / move.scale
    for k in range(2):
        ends = np.asarray(edges[2 * k : 2 * k + 2], np.float64)
        pair = (ends - axes[k] @ move.shift) / move.scale
        # A mirrored axis points backwards, so its two ends change places.
        if moved_axes[k, k] < 0:
            moved_axes[k] *= -1
            pair = -pair[::-1]
        moved[2 * k : 2 * k + 2] = pair
    return moved, float(np.arctan2(moved_axes[0, 1], moved_axes[0, 0]))


def edges_of_box(box: NDArray[np.floating]) -> NDArray[np.float64]:
    """Compute ends and sides of an exact box relative to its candidate (``Rows.box``)."""
    x, y, log_length, log_width, turn = [float(value) for value in box]
    along = np.cos(turn) * x + np.sin(turn) * y
    across = np.cos(turn) * y - np.sin(turn) * x
    half_length = np.exp(log_length) / 2
    half_width = np.exp(log_width) / 2
    return np.array(
        [along - half_length, along + half_length, across - half_width, across + half_width]
    )


def coarsened(rng: Generator, chip: Chip, length_px: float) -> Chip:
    """Simulate a coarser image, in some of the cases."""
    finest = min(length_px, CHIP_LENGTH_PX)
    if rng.random() >= _COARSE_SHARE or finest <= _COARSEST_PX:
        return chip
    log_length = rng.uniform(np.log(_COARSEST_PX), np.log(finest))
    factor = float(np.exp(log_length)) / CHIP_LENGTH_PX
    small = (max(8, round(CHIP_COLUMNS * factor)), max(6, round(CHIP_ROWS * factor)))
    if small[0] >= CHIP_COLUMNS:
        return chip
    coarse = cv2.resize(chip, small, interpolation=cv2.INTER_AREA)
    method = cv2.INTER_CUBIC if rng.random() < 0.3 else cv2.INTER_LINEAR
    enlarged = cv2.resize(coarse, (CHIP_COLUMNS, CHIP_ROWS), interpolation=method)
    return np.asarray(enlarged, np.uint8)


class Target(NamedTuple):
    """Targets of a stored chip, before it is moved; see ``Batch``."""

    car: float
    kind: int
    kind_weight: float
    edges: NDArray[np.float64]
    turn: float
    edge_weight: float
    log_metres: tuple[float, float]
    metres_weight: tuple[float, float]


class Bodies(NamedTuple):
    """Bodies that a first network measured (``bodies.py``).

    Attributes:
        log_metres: ``[n, 2]`` logs of length and width, NaN where the scale is unknown.
        weight: ``[n, 2]`` 0..1.
    """

    log_metres: NDArray[np.float32]
    weight: NDArray[np.float32]

    @classmethod
    def load(cls, path: Path, count: int) -> Bodies:
        """Load bodies; all are unknown without a file."""
        if not path.exists():
            unknown = np.full((count, 2), np.nan, np.float32)
            return cls(unknown, np.zeros((count, 2), np.float32))
        with np.load(path) as stored:
            return cls(stored["log_metres"], stored["weight"])


def target_of_row(rows: Rows, bodies: Bodies, k: int) -> Target:
    """Make the targets of a candidate."""
    rendered = str(rows.sets[k]) in _RENDERED
    kind = int(rows.type[k])
    if rows.car[k] == 0 and KINDS[kind] not in ("lorry", "trailer"):
        kind = NOT_A_CAR if kind == KINDS.index("other") else UNKNOWN
    edges = np.full(4, np.nan)
    turn = 0.0
    weight = 0.0
    metres = (np.nan, np.nan)
    metres_weight = (0.0, 0.0)
    length = float(rows.log_length_m[k])
    if rendered and np.isfinite(rows.box[k]).all():
        edges = edges_of_box(rows.box[k])
        turn = float(rows.box[k][4])
        weight = _RENDERED_WEIGHT
        log_proportions = float(rows.box[k][3] - rows.box[k][2])
        metres = (length, length + log_proportions)
        metres_weight = (_RENDERED_WEIGHT / 3, _RENDERED_WEIGHT / 3)
    elif bodies.weight[k].any():
        metres = (float(bodies.log_metres[k, 0]), float(bodies.log_metres[k, 1]))
        length_weight = _MEASURED_WEIGHT * float(bodies.weight[k, 0])
        width_weight = _MEASURED_WEIGHT * float(bodies.weight[k, 1])
        metres_weight = (length_weight, width_weight)
    elif np.isfinite(length):
        metres = (length, np.nan)
        metres_weight = (_BOX_WEIGHT, 0.0)
    return Target(
        car=float(rows.car[k]),
        kind=kind,
        kind_weight=_RENDERED_WEIGHT if rendered else 1.0,
        edges=edges,
        turn=turn,
        edge_weight=weight,
        log_metres=metres,
        metres_weight=metres_weight,
    )


def sized_kinds(read: Read, bodies: Bodies) -> NDArray[np.int64]:
    """Correct the kinds of readings: a compact car that was measured shorter is a small one."""
    short = bodies.log_metres[:, 0] < np.log(_LONGEST_SMALL_M)
    short &= (read.kind == KINDS.index("compact")) & ~np.isin(read.place, _MEASURED_BY_EYE)
    return np.where(short, KINDS.index("small"), read.kind)


def target_of_reading(read: Read, bodies: Bodies, k: int) -> Target:
    """Make the targets of a car that was read by eye."""
    kind = int(read.kind[k])
    edges = read.edges[k].astype(np.float64)
    gsd = float(read.gsd[k])
    # An object without edges and of an unknown kind need not be a car.
    car = np.nan
    if kind != UNKNOWN or not np.isnan(edges).all():
        car = float(kind == UNKNOWN or KINDS[kind] in CARS)
    relative = np.array([edges[1] - edges[0], edges[3] - edges[2]])
    sizes = relative * read.length_px[k] * gsd
    weights = np.ones(2)
    if np.isnan(edges).all() and car == 1:
        sizes = np.exp(bodies.log_metres[k].astype(np.float64))
        weights = _MEASURED_WEIGHT * bodies.weight[k].astype(np.float64)
    if KINDS[kind] in CARS and kind != UNKNOWN:
        weights = np.where(np.isnan(sizes), _TABLE_WEIGHT, weights)
        sizes = np.where(np.isnan(sizes), np.array(BODY_M[KINDS[kind]]), sizes)
    weights = np.where(np.isnan(sizes) | (car != 1), 0.0, weights)
    logs = np.log(np.where(weights > 0, sizes, 1.0))
    return Target(
        car=car,
        kind=kind,
        kind_weight=1.0,
        edges=edges,
        turn=0.0,
        edge_weight=1.0,
        log_metres=(logs[0], logs[1]),
        metres_weight=(weights[0], weights[1]),
    )


class ChipStream:
    """Examples of stores and readings; the k-th is a function of the seed, of k and of the sources.

    Args:
        stores: folders of ``research.training.chips.store.ChipStore``.
        read: readings to learn from.
        bodies: bodies of these readings.
        seed: seed of the draws.
    """

    def __init__(self, stores: Sequence[Path], read: Read, bodies: Bodies, seed: int) -> None:
        self._seed = seed
        self._read = read._replace(kind=sized_kinds(read, bodies))
        self._read_bodies = bodies
        read = self._read
        parts = [read_store(folder) for folder in stores]
        self._chips = [chips for chips, _ in parts]
        self._rows = Rows.joined([rows for _, rows in parts])
        measured = [
            Bodies.load(folder / "bodies.npz", len(rows.car))
            for folder, (_, rows) in zip(stores, parts, strict=True)
        ]
        self._bodies = Bodies(*(np.concatenate(column) for column in zip(*measured, strict=True)))
        # The store of each row, and its index there.
        n_rows = [len(rows.car) for _, rows in parts]
        self._store = np.concatenate([np.full(n, k) for k, n in enumerate(n_rows)])
        self._index = np.concatenate([np.arange(n) for n in n_rows])
        has_ends = np.isfinite(read.edges).any(axis=1)
        kinds_alone = np.flatnonzero(~has_ends & (read.kind != UNKNOWN))
        places_and_kinds = np.array(
            [f"{place} {kind}" for place, kind in zip(read.place, read.kind, strict=True)]
        )
        self._others = self._weighed(np.flatnonzero(self._rows.car == 0), self._rows.sets)
        self._cars = self._weighed(np.flatnonzero(self._rows.car == 1), self._rows.sets)
        self._ends = self._weighed(np.flatnonzero(has_ends), read.place)
        self._kinds = self._weighed(kinds_alone, places_and_kinds)

    @staticmethod
    def _weighed(
        indices: NDArray[np.intp], names: NDArray[np.str_]
    ) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Return the indices, and cumulated odds by the root of the number of each name."""
        return indices, np.cumsum(weight_of_sets(names[indices]))

    def __getitem__(self, index: int) -> Batch:
        """Make the example of an index."""
        cv2.setNumThreads(1)
        rng = np.random.default_rng([self._seed, index])
        source = int(rng.choice(3, p=_SHARES))
        # The number is drawn for each source, so that all sources draw the same ones after it.
        candidates = self._cars if rng.random() < _CAR_SHARE else self._others
        indices, odds = (candidates, self._ends, self._kinds)[source]
        drawn = int(np.searchsorted(odds, rng.random()))
        k = int(indices[min(drawn, len(odds) - 1)])
        move = draw_move(rng)
        if source == 0:
            target = target_of_row(self._rows, self._bodies, k)
            name = str(self._rows.sets[k])
            length_px = self._rows.length_px[k]
            stored = np.asarray(self._chips[self._store[k]][self._index[k]])
            chip = cut(stored, STORED_LENGTH_PX, move)
        else:
            target = target_of_reading(self._read, self._read_bodies, k)
            name = "read"
            length_px = self._read.length_px[k]
            chip = cut(self._read.chips[k], READ_LENGTH_PX, move)
        if name not in _RENDERED:
            chip = shaded(rng, chip, _CANDIDATE)
        chip = photometric(rng, coarsened(rng, chip, float(length_px)))
        edges, turn = moved_edges(target.edges, target.turn, move)
        return Batch(
            chip=torch.from_numpy(np.ascontiguousarray(chip.transpose(2, 0, 1))),
            car=torch.tensor(target.car, dtype=torch.float32),
            kind=torch.tensor(target.kind),
            kind_weight=torch.tensor(target.kind_weight, dtype=torch.float32),
            edges=torch.from_numpy(edges),
            turn=torch.tensor(turn, dtype=torch.float32),
            edge_weight=torch.tensor(target.edge_weight, dtype=torch.float32),
            log_metres=torch.tensor(target.log_metres, dtype=torch.float32),
            metres_weight=torch.tensor(target.metres_weight, dtype=torch.float32),
        )
