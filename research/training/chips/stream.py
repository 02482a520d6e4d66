"""Endless stream of chips from stores and readings, with random geometry, sharpness and colour."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from research.training.chips.kinds import BODY_M, CARS, UNKNOWN
from research.training.chips.readings import READ_LENGTH_PX, Read
from research.training.chips.store import STORED_LENGTH_PX, Rows, read_store
from research.training.detector.data import photometric
from research.training.detector.shade import shaded
from research.training.logistic import weight_of_sets
from vehanchor.detection.chips import CHIP_COLUMNS, CHIP_LENGTH_PX, CHIP_ROWS, KINDS

# standard deviations: lengths, log, radians
_SHIFT = 0.06
_SCALE = 0.08
_TURN = 0.07
_MOST = 2.2  # standard deviations; a car's box still fits there
_COARSE_SHARE = 0.45
_COARSEST_PX = 10.0
_CANDIDATE = np.array(
    [[CHIP_COLUMNS / 2, CHIP_ROWS / 2, CHIP_LENGTH_PX, 0.45 * CHIP_LENGTH_PX, 0.0]]
)
# of candidates, of readings of ends and sides, of readings of kinds alone
_SHARES = (0.68, 0.18, 0.14)
_CAR_SHARE = 0.5
_RENDERED = ("scene", "pasted")
_RENDERED_WEIGHT = 0.25
_BOX_WEIGHT = 0.3  # of a length in metres that a box gives
# of a length or width that a first network has measured, times its own weight
_MEASURED_WEIGHT = 0.8
_LONGEST_SMALL_M = 3.9  # of a two-box car; at an unknown scale readings call all of these compact
_MEASURED_BY_EYE = ("mashiki", "fuji", "bergamo", "garfield")
_TABLE_WEIGHT = 0.2  # of the size of a kind where the scale is unknown
NOT_A_CAR = -2  # some kind that is no car


class Batch(NamedTuple):
    """Example or batch: a chip and its targets; NaN, -1 and weights of 0 for what nobody knows.

    Attributes:
        chip: ``[3, 64, 96]`` uint8.
        car: 1, 0 or NaN.
        kind: index into ``KINDS``, -1, or -2 for any that is no car.
        kind_weight: of the kind.
        edges: ``[4]`` in candidate lengths.
        turn: radians.
        edge_weight: of edges and turn.
        log_metres: ``[2]`` logs of length and width.
        metres_weight: ``[2]``.
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
    """How a chip is cut from a stored one: ``stored = shift + scale * rotation(turn) @ (flip * chip)``, in lengths."""

    shift: NDArray[np.float64]
    scale: float
    turn: float
    flip: NDArray[np.float64]

    @property
    def matrix(self) -> NDArray[np.float64]:
        """``[2, 2]`` from the chip to the stored chip."""
        cos = np.cos(self.turn)
        sin = np.sin(self.turn)
        return np.asarray(self.scale * np.array([[cos, -sin], [sin, cos]]) * self.flip[None])


STILL = Move(np.zeros(2), 1.0, turn=0.0, flip=np.ones(2))


def draw_move(rng: np.random.Generator) -> Move:
    """A candidate a little off, mirrored at random."""
    shift, scale, turn = (np.clip(rng.normal(0, 1, n), -_MOST, _MOST) for n in (2, 1, 1))
    return Move(
        _SHIFT * shift,
        float(np.exp(_SCALE * scale[0])),
        turn=float(_TURN * turn[0]),
        flip=rng.choice((-1.0, 1.0), 2),
    )


def cut(stored: NDArray[np.uint8], length_px: float, move: Move = STILL) -> NDArray[np.uint8]:
    """A chip ``[64, 96, 3]`` of a stored square on which the candidate is ``length_px`` long."""
    matrix = move.matrix * (length_px / CHIP_LENGTH_PX)
    middle = np.array([CHIP_COLUMNS, CHIP_ROWS]) / 2
    origin = stored.shape[0] / 2 + move.shift * length_px - matrix @ middle
    full = np.column_stack([matrix, origin])
    # continuous coordinates have pixel centres at +0.5
    full[:, 2] += full[:, :2] @ (0.5, 0.5) - 0.5
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    size = (CHIP_COLUMNS, CHIP_ROWS)
    return np.asarray(
        cv2.warpAffine(stored, full, size, flags=flags, borderMode=cv2.BORDER_REPLICATE), np.uint8
    )


def moved_edges(
    edges: NDArray[np.floating], turn: float, move: Move
) -> tuple[NDArray[np.float32], float]:
    """Edges and turn of a body as the moved chip sees them; the first end is the left one, the first side the upper."""
    axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    out = np.empty(4, np.float32)
    seen = axes @ move.matrix / move.scale
    for k in range(2):
        pair = (
            np.asarray(edges[2 * k : 2 * k + 2], np.float64) - axes[k] @ move.shift
        ) / move.scale
        backward = seen[k, k] < 0
        seen[k] *= -1 if backward else 1
        out[2 * k : 2 * k + 2] = -pair[::-1] if backward else pair
    return out, float(np.arctan2(seen[0, 1], seen[0, 0]))


def edges_of_box(box: NDArray[np.floating]) -> NDArray[np.float64]:
    """Ends and sides of an exact box relative to its candidate (``Rows.box``)."""
    x, y, log_length, log_width, turn = (float(value) for value in box)
    along = np.cos(turn) * x + np.sin(turn) * y
    across = np.cos(turn) * y - np.sin(turn) * x
    half_length = np.exp(log_length) / 2
    half_width = np.exp(log_width) / 2
    return np.array(
        [along - half_length, along + half_length, across - half_width, across + half_width]
    )


def coarsened(
    rng: np.random.Generator, chip: NDArray[np.uint8], length_px: float
) -> NDArray[np.uint8]:
    """Sometimes simulate a coarser image."""
    finest = min(length_px, CHIP_LENGTH_PX)
    if rng.random() >= _COARSE_SHARE or finest <= _COARSEST_PX:
        return chip
    factor = float(np.exp(rng.uniform(np.log(_COARSEST_PX), np.log(finest)))) / CHIP_LENGTH_PX
    small = (max(8, round(CHIP_COLUMNS * factor)), max(6, round(CHIP_ROWS * factor)))
    if small[0] >= CHIP_COLUMNS:
        return chip
    coarse = cv2.resize(chip, small, interpolation=cv2.INTER_AREA)
    way = cv2.INTER_CUBIC if rng.random() < 0.3 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(coarse, (CHIP_COLUMNS, CHIP_ROWS), interpolation=way), np.uint8)


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
    """Bodies that a first network has measured (``bodies.py``).

    Attributes:
        log_metres: ``[n, 2]`` logs of length and width, NaN where nobody knows the scale.
        weight: ``[n, 2]`` 0..1.
    """

    log_metres: NDArray[np.float32]
    weight: NDArray[np.float32]

    @classmethod
    def load(cls, path: Path, count: int) -> Bodies:
        """Read bodies; none where nobody has measured them."""
        if not path.exists():
            return cls(np.full((count, 2), np.nan, np.float32), np.zeros((count, 2), np.float32))
        with np.load(path) as stored:
            return cls(stored["log_metres"], stored["weight"])


def target_of_row(rows: Rows, bodies: Bodies, k: int) -> Target:
    """Targets of a candidate."""
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
        metres = (length, length + float(rows.box[k][3] - rows.box[k][2]))
        metres_weight = (_RENDERED_WEIGHT / 3, _RENDERED_WEIGHT / 3)
    elif bodies.weight[k].any():
        metres = (float(bodies.log_metres[k, 0]), float(bodies.log_metres[k, 1]))
        by_length, by_width = (_MEASURED_WEIGHT * float(weight) for weight in bodies.weight[k])
        metres_weight = (by_length, by_width)
    elif np.isfinite(length):
        metres = (length, np.nan)
        metres_weight = (_BOX_WEIGHT, 0.0)
    kind_weight = _RENDERED_WEIGHT if rendered else 1.0
    return Target(float(rows.car[k]), kind, kind_weight, edges, turn, weight, metres, metres_weight)


def sized_kinds(read: Read, bodies: Bodies) -> NDArray[np.int64]:
    """Kinds of readings, a compact car being small if it was measured shorter."""
    short = bodies.log_metres[:, 0] < np.log(_LONGEST_SMALL_M)
    short &= (read.kind == KINDS.index("compact")) & ~np.isin(read.place, _MEASURED_BY_EYE)
    return np.where(short, KINDS.index("small"), read.kind)


def target_of_reading(read: Read, bodies: Bodies, k: int) -> Target:
    """Targets of a car that was read by eye; one whose kind an eye could not tell may be no car."""
    kind = int(read.kind[k])
    edges = read.edges[k].astype(np.float64)
    gsd = float(read.gsd[k])
    car = (
        np.nan
        if kind == UNKNOWN and np.isnan(edges).all()
        else float(kind == UNKNOWN or KINDS[kind] in CARS)
    )
    sizes = np.array([edges[1] - edges[0], edges[3] - edges[2]]) * read.length_px[k] * gsd
    weights = np.ones(2)
    if np.isnan(edges).all() and car == 1:
        sizes = np.exp(bodies.log_metres[k].astype(np.float64))
        weights = _MEASURED_WEIGHT * bodies.weight[k].astype(np.float64)
    if KINDS[kind] in CARS and kind != UNKNOWN:
        table = np.array(BODY_M[KINDS[kind]])
        sizes, weights = (
            np.where(np.isnan(sizes), table, sizes),
            np.where(np.isnan(sizes), _TABLE_WEIGHT, weights),
        )
    weights = np.where(np.isnan(sizes) | (car != 1), 0.0, weights)
    logs = np.log(np.where(weights > 0, sizes, 1.0))
    return Target(car, kind, 1.0, edges, 0.0, 1.0, (logs[0], logs[1]), (weights[0], weights[1]))


class ChipStream:
    """Examples of stores and readings; the k-th is a function of the seed, of k and of the sources.

    Args:
        stores: folders of ``research.training.chips.store.ChipStore``.
        read: readings to learn from.
        bodies: of these readings.
        seed: of the draws.
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
        self._store = np.concatenate(
            [np.full(len(rows.car), k) for k, (_, rows) in enumerate(parts)]
        )
        self._index = np.concatenate([np.arange(len(rows.car)) for _, rows in parts])
        self._rows_by_car = [
            self._weighed(np.flatnonzero(self._rows.car == car), self._rows.sets) for car in (0, 1)
        ]
        ends = np.isfinite(read.edges).any(axis=1)
        named = np.array(
            [f"{place} {kind}" for place, kind in zip(read.place, read.kind, strict=True)]
        )
        self._ends = self._weighed(np.flatnonzero(ends), read.place)
        self._kinds = self._weighed(np.flatnonzero(~ends & (read.kind != UNKNOWN)), named)

    @staticmethod
    def _weighed(
        chosen: NDArray[np.intp], names: NDArray[np.str_]
    ) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Indices, and cumulated odds by the root of the number of each name."""
        return chosen, np.cumsum(weight_of_sets(names[chosen]))

    def __getitem__(self, index: int) -> Batch:
        """The example of an index."""
        cv2.setNumThreads(1)
        rng = np.random.default_rng([self._seed, index])
        source = int(rng.choice(3, p=_SHARES))
        pick, odds = (self._rows_by_car[int(rng.random() < _CAR_SHARE)], self._ends, self._kinds)[
            source
        ]
        k = int(pick[min(int(np.searchsorted(odds, rng.random())), len(odds) - 1)])
        move = draw_move(rng)
        if source == 0:
            target = target_of_row(self._rows, self._bodies, k)
            name = str(self._rows.sets[k])
            length_px = self._rows.length_px[k]
            chip = cut(
                np.asarray(self._chips[self._store[k]][self._index[k]]), STORED_LENGTH_PX, move
            )
        else:
            target = target_of_reading(self._read, self._read_bodies, k)
            name = "read"
            length_px = self._read.length_px[k]
            chip = cut(self._read.chips[k], READ_LENGTH_PX, move)
        if name not in _RENDERED:
            chip = shaded(rng, chip, _CANDIDATE)
        chip = photometric(rng, coarsened(rng, chip, float(length_px)))
        edges, turn = moved_edges(target.edges, target.turn, move)
        numbers = (target.car, target.kind_weight, turn, target.edge_weight)
        car, kind_weight, turned, edge_weight = (
            torch.tensor(value, dtype=torch.float32) for value in numbers
        )
        metres, metres_weight = (
            torch.tensor(v, dtype=torch.float32) for v in (target.log_metres, target.metres_weight)
        )
        return Batch(
            torch.from_numpy(np.ascontiguousarray(chip.transpose(2, 0, 1))), car,
            torch.tensor(target.kind), kind_weight, torch.from_numpy(edges), turned, edge_weight,
            metres, metres_weight,
        )  # fmt: skip
