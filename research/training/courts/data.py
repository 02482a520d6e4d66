"""Crops with and without courts, at 0.38 to 0.88 m/px, from real tiles and rendered scenes."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import cv2
import numpy as np
import torch

from research.training.courts.network import CELL_PX, LENGTH_PX
from research.training.detector.places import is_held_out, places

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.random import Generator
    from numpy.typing import NDArray
    from torch import Tensor

    Pixels: TypeAlias = NDArray[np.uint8]
    """RGB picture ``[h, w, 3]``."""

SIDE_PX = 96
# Range of the crops' metres per pixel.
FINEST_M = 0.38
COARSEST_M = 0.88
TENNIS_M = 23.77
BASKETBALL_M = 28.3
_LABELS = Path(__file__).with_name("tennis.csv")
# Shares of real courts, rendered scenes, and places without courts.
_SHARES = (0.45, 0.25, 0.30)
_MAX_EMPTY = 300
# Weight of cells of a real tile without a marked court: courts at its edge are not marked.
_UNSURE = 0.2
_SPREAD_CELLS = 0.9


class Court(NamedTuple):
    """Court: centre in pixels, angle of its long axis, class (0 tennis, 1 basketball)."""

    x: float
    y: float
    angle: float
    which: int


class Picture(NamedTuple):
    """Image with its courts.

    Attributes:
        pixels: ``[h, w, 3]`` RGB.
        gsd_m_per_px: its scale.
        courts: its courts.
        sure: whether these are all.
    """

    pixels: Pixels
    gsd_m_per_px: float
    courts: tuple[Court, ...]
    sure: bool


def _read(path: Path) -> Pixels:
    image = cv2.imread(str(path))
    if image is None:
        raise FileNotFoundError(path)
    return np.ascontiguousarray(image[:, :, ::-1]).astype(np.uint8, copy=False)


def load_real(data: Path) -> list[Picture]:
    """Load the tennis tiles that train, with the courts of ``tennis.csv``."""
    courts: dict[str, list[Court]] = {}
    with _LABELS.open(newline="") as handle:
        for row in csv.DictReader(handle):
            angle = math.radians(float(row["angle_deg"]))
            court = Court(float(row["x"]), float(row["y"]), angle, 0)
            courts.setdefault(row["file"], []).append(court)
    return [
        Picture(_read(place.path), place.gsd_m_per_px, tuple(courts[place.path.name]), False)
        for place in places(data)
        if place.path.name in courts and not is_held_out(place)
    ]


def load_rendered(folder: Path) -> list[Picture]:
    """Load scenes of ``render_scenes courts``."""
    pictures = []
    for path in sorted(folder.glob("*.json")):
        facts = json.loads(path.read_text())
        courts = []
        for court in facts["courts"]:
            corners = np.array(court["corners"])
            x, y = corners.mean(axis=0)
            dx, dy = corners[1] - corners[0]
            which = 0 if court["kind"] == "tennis" else 1
            courts.append(Court(x, y, math.atan2(dy, dx), which))
        pixels = _read(path.with_suffix(".png"))
        pictures.append(Picture(pixels, facts["gsd"], courts=tuple(courts), sure=True))
    return pictures


def load_empty(data: Path) -> list[Picture]:
    """Load places of the training splits that are not named for their courts."""
    files = [
        (place.path, place.gsd_m_per_px)
        for place in places(data)
        if place.kind != "tenniscourt" and not is_held_out(place)
    ]
    with (data / "gsd" / "table.csv").open(newline="") as handle:
        for row in csv.DictReader(handle):
            if row["split"] == "train":
                files.append((data / "gsd" / row["file"], float(row["gsd_m_per_px"])))
    pictures = []
    for index in np.random.default_rng(0).permutation(len(files))[:_MAX_EMPTY]:
        path, gsd = files[index]
        pictures.append(Picture(_read(path), gsd, courts=(), sure=True))
    return pictures


class CropStream:
    """Endless seeded crops: item k is always the same.

    Args:
        groups: pictures with real courts, rendered ones, and others.
        seed: seed of the stream.
    """

    def __init__(self, groups: Sequence[Sequence[Picture]], seed: int) -> None:
        self.groups = groups
        self.seed = seed

    def __getitem__(self, index: int) -> tuple[Tensor, Tensor, Tensor]:
        """Make pixels ``[3, 96, 96]`` in 0..1, targets ``[5, 12, 12]``, weights ``[2, 12, 12]``."""
        rng = np.random.default_rng((self.seed, index))
        group = self.groups[int(rng.choice(3, p=_SHARES))]
        picture = group[int(rng.integers(len(group)))]
        gsd = math.exp(rng.uniform(math.log(FINEST_M), math.log(COARSEST_M)))
        pixels, courts = _crop(picture, gsd, rng)
        targets, weights = _targets(courts, gsd, sure=picture.sure)
        recoloured = _recoloured(pixels, rng)
        return (
            torch.from_numpy(recoloured.transpose(2, 0, 1).copy()),
            torch.from_numpy(targets),
            torch.from_numpy(weights),
        )


def _crop(picture: Picture, gsd: float, rng: Generator) -> tuple[Pixels, list[Court]]:
    """Cut a crop at a scale, turned at random and mirrored, and its courts in pixels."""
    factor = picture.gsd_m_per_px / gsd
    method = cv2.INTER_AREA if factor < 1 else cv2.INTER_LINEAR
    reduced = cv2.resize(picture.pixels, None, fx=factor, fy=factor, interpolation=method)
    if rng.random() < 0.5:
        turn = rng.uniform(0, 2 * math.pi)
    else:
        turn = math.pi / 2 * int(rng.integers(4))
    centre = rng.uniform((0, 0), (reduced.shape[1], reduced.shape[0]))
    if picture.courts:
        court = picture.courts[rng.integers(len(picture.courts))]
        centre = np.array([court.x, court.y]) * factor + rng.uniform(-32, 32, 2)
    mirror = -1.0 if rng.random() < 0.5 else 1.0
    cos = math.cos(turn)
    sin = math.sin(turn)
    rotation = np.array([[cos, -sin], [sin, cos]])
    linear = rotation @ np.diag([mirror, 1.0])
    shift = SIDE_PX / 2 - linear @ centre
    matrix = np.column_stack([linear, shift])
    pixels = cv2.warpAffine(reduced, matrix, (SIDE_PX, SIDE_PX), borderMode=cv2.BORDER_CONSTANT)
    courts = []
    for court in picture.courts:
        x, y = linear @ (np.array([court.x, court.y]) * factor) + shift
        dx, dy = linear @ (math.cos(court.angle), math.sin(court.angle))
        angle = math.atan2(dy, dx)
        courts.append(Court(float(x), float(y), angle, court.which))
    return np.asarray(pixels, np.uint8), courts


def _targets(
    courts: list[Court], gsd: float, *, sure: bool
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Draw heats by class, and poses of the nearest court; weigh unmarked cells less."""
    cells = SIDE_PX // CELL_PX
    targets = np.zeros((5, cells, cells), np.float32)
    weights = np.full((2, cells, cells), 1.0 if sure else _UNSURE, np.float32)
    rows, columns = np.mgrid[:cells, :cells]
    best = np.zeros((cells, cells))
    for x, y, angle, which in courts:
        u = x / CELL_PX - 0.5
        v = y / CELL_PX - 0.5
        squared_distance = (columns - u) ** 2 + (rows - v) ** 2
        heat = np.exp(-squared_distance / (2 * _SPREAD_CELLS**2))
        targets[which] = np.maximum(targets[which], heat)
        length = (BASKETBALL_M if which else TENNIS_M) / gsd
        pose = math.cos(2 * angle), math.sin(2 * angle), math.log(length / LENGTH_PX)
        nearer = heat > best
        for channel, value in enumerate(pose):
            targets[2 + channel][nearer] = value
        best = np.maximum(best, heat)
        weights[:, heat > 0.3] = 1.0
    return targets, weights


def _recoloured(pixels: Pixels, rng: Generator) -> NDArray[np.float32]:
    """Change saturation, order of channels, gain, gamma, sharpness and noise at random."""
    values = pixels.astype(np.float32) / 255.0
    grey = values.mean(axis=2, keepdims=True)
    least_saturation = 0.0 if rng.random() < 0.1 else 0.5
    values = grey + (values - grey) * rng.uniform(least_saturation, 1.5)
    if rng.random() < 0.3:
        values = values[:, :, rng.permutation(3)]
    n_gains = 3 if rng.random() < 0.3 else 1
    values = values * rng.uniform(0.6, 1.4, n_gains) + rng.uniform(-0.1, 0.1)
    values = np.clip(values, 0, 1) ** rng.uniform(0.7, 1.4)
    if rng.random() < 0.3:
        values = cv2.GaussianBlur(values, (0, 0), rng.uniform(0.3, 0.8))
    noise = rng.normal(0, rng.uniform(0, 0.03), values.shape)
    return np.asarray(np.clip(values + noise, 0, 1), np.float32)
