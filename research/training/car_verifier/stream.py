"""Endless stream of chips from stores, with random geometry, resolution and colour."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from research.training.car_verifier.store import STORED_LENGTH_PX, STORED_PX, Rows, read_store
from research.training.detector.data import photometric
from research.training.detector.shade import shaded
from vehanchor.detection.car_verifier import CHIP_LENGTH_PX, CHIP_PX

_SHIFT, _SCALE, _TURN = 0.06, 0.08, 0.07  # standard deviations: lengths, log, radians
_MOST = 2.2  # standard deviations; a car's box still fits there
_COARSE_SHARE = 0.45
_COARSEST_PX = 11.0  # length of the candidate
_CANDIDATE = np.array([[CHIP_PX / 2, CHIP_PX / 2, CHIP_LENGTH_PX, 0.45 * CHIP_LENGTH_PX, 0.0]])
_CAR_SHARE = 0.5


class Batch(NamedTuple):
    """Example or batch: chips and targets; NaN and -1 for unknown targets."""

    chip: Tensor
    car: Tensor
    type: Tensor
    box: Tensor
    box_weight: Tensor
    log_length_m: Tensor


class Move(NamedTuple):
    """How a chip is cut from a stored one: ``stored = shift + scale * rotation(turn) @ (flip * chip)``, in lengths."""

    shift: NDArray[np.float64]
    scale: float
    turn: float
    flip: NDArray[np.float64]

    @property
    def matrix(self) -> NDArray[np.float64]:
        """``[2, 2]`` from the chip to the stored chip."""
        cos, sin = np.cos(self.turn), np.sin(self.turn)
        return np.asarray(self.scale * np.array([[cos, -sin], [sin, cos]]) * self.flip[None])


def draw_move(rng: np.random.Generator) -> Move:
    """A candidate a little off, mirrored at random."""
    shift, scale, turn = (np.clip(rng.normal(0, 1, n), -_MOST, _MOST) for n in (2, 1, 1))
    return Move(_SHIFT * shift, float(np.exp(_SCALE * scale[0])), float(_TURN * turn[0]), rng.choice((-1.0, 1.0), 2))


def cut(stored: NDArray[np.uint8], move: Move, side_px: int = CHIP_PX) -> NDArray[np.uint8]:
    """A chip ``[side, side, 3]`` of a stored one."""
    matrix = move.matrix * (STORED_LENGTH_PX / (CHIP_LENGTH_PX * side_px / CHIP_PX))
    origin = STORED_PX / 2 + move.shift * STORED_LENGTH_PX - matrix @ [side_px / 2, side_px / 2]
    full = np.column_stack([matrix, origin])
    full[:, 2] += full[:, :2] @ (0.5, 0.5) - 0.5  # continuous coordinates have pixel centres at +0.5
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return np.asarray(
        cv2.warpAffine(stored, full, (side_px, side_px), flags=flags, borderMode=cv2.BORDER_REPLICATE), np.uint8
    )


def moved_box(box: NDArray[np.floating], move: Move) -> NDArray[np.float32]:
    """A relative box ``[5]`` of the stored chip, as the chip sees it."""
    inverse = np.linalg.inv(move.matrix)
    x, y = inverse @ (box[:2] - move.shift)
    along = inverse @ (np.cos(box[4]), np.sin(box[4]))
    turn = (np.arctan2(along[1], along[0]) + np.pi / 2) % np.pi - np.pi / 2
    return np.array([x, y, box[2] - np.log(move.scale), box[3] - np.log(move.scale), turn], np.float32)


def coarsened(rng: np.random.Generator, chip: NDArray[np.uint8], length_px: float) -> NDArray[np.uint8]:
    """Sometimes simulate a coarser image."""
    if rng.random() >= _COARSE_SHARE:
        return chip
    finest = min(length_px, 1.2 * CHIP_LENGTH_PX)
    if finest <= _COARSEST_PX:
        return chip
    target = float(np.exp(rng.uniform(np.log(_COARSEST_PX), np.log(finest))))
    small = max(12, round(CHIP_PX * target / CHIP_LENGTH_PX))
    if small >= CHIP_PX:
        return chip
    coarse = cv2.resize(chip, (small, small), interpolation=cv2.INTER_AREA)
    way = cv2.INTER_CUBIC if rng.random() < 0.3 else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(coarse, (CHIP_PX, CHIP_PX), interpolation=way), np.uint8)


class ChipStream:
    """Examples of one or several stores; the k-th is a function of the seed, of k and of the stores.

    Args:
        stores: folders of ``store.ChipStore``.
        seed: of the draws.
        without: sets that are left out.
    """

    def __init__(self, stores: Sequence[Path], seed: int, without: Sequence[str] = ()) -> None:
        self._seed = seed
        parts = [read_store(folder) for folder in stores]
        self._chips = [chips for chips, _ in parts]
        self._rows = Rows.joined([rows for _, rows in parts])
        self._store = np.concatenate([np.full(len(rows.car), k) for k, (_, rows) in enumerate(parts)])
        self._index = np.concatenate([np.arange(len(rows.car)) for _, rows in parts])
        self._pick, self._odds = [], []
        for car in (0, 1):
            chosen = np.flatnonzero((self._rows.car == car) & ~np.isin(self._rows.sets, list(without)))
            names, number, counts = np.unique(self._rows.sets[chosen], return_inverse=True, return_counts=True)
            odds = np.cumsum((1 / np.sqrt(counts))[number])
            self._pick.append(chosen)
            self._odds.append(odds / odds[-1])
            shares = dict(zip(names.tolist(), (np.sqrt(counts) / np.sqrt(counts).sum()).round(3).tolist(), strict=True))
            print(f"{'cars' if car else 'others'}: {len(chosen)}, {shares}", flush=True)

    def __getitem__(self, index: int) -> Batch:
        """The example of an index."""
        cv2.setNumThreads(1)
        rng = np.random.default_rng([self._seed, index])
        car = int(rng.random() < _CAR_SHARE)
        odds = self._odds[car]
        row = int(self._pick[car][min(int(np.searchsorted(odds, rng.random())), len(odds) - 1)])
        move = draw_move(rng)
        chip = cut(np.asarray(self._chips[self._store[row]][self._index[row]]), move)
        if self._rows.sets[row] not in ("scene", "pasted"):
            chip = shaded(rng, chip, _CANDIDATE)
        chip = photometric(rng, coarsened(rng, chip, float(self._rows.length_px[row])))
        box = np.zeros(5, np.float32)
        weight = float(self._rows.box_weight[row])
        if weight > 0:
            box = moved_box(self._rows.box[row].astype(np.float64), move)
        return Batch(
            torch.from_numpy(np.ascontiguousarray(chip.transpose(2, 0, 1))),
            torch.tensor(float(car)),
            torch.tensor(int(self._rows.type[row])),
            torch.from_numpy(box),
            torch.tensor(weight),
            torch.tensor(float(self._rows.log_length_m[row])),
        )
