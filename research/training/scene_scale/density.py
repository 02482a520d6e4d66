"""Choose tiles of an image and combine their answers into one density over log metres per pixel.

A network tells of a tile of 160 px how many metres a pixel is. An image is looked at on tiles spread over it at its own
resolution and at 1/2, 1/4 and 1/8: the further view tells houses and roads where the near one sees nothing but grass.
The log-probabilities of a level's tiles are averaged (tiles that disagree flatten it), sharpened or flattened by a
temperature, mixed with a little doubt, shifted by the level's factor, and averaged over the levels; what comes out is
mixed with a flat floor, the chance of being wrong altogether.

A bin at either end stands for all that is finer or coarser: beyond them nothing is known, so
nothing is denied.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.detection import scene_scale
from vehanchor.scale.density import GRID

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

TILE_PX = 160
FACTORS = (1, 2, 4, 8)  # by which an image is reduced
MOST_TILES = 24  # of a level
INTERVAL = 0.95


@dataclass(frozen=True)
class SceneBins:
    """The bins of a network's answers, ``vehanchor.scene_bins`` of its file.

    Attributes:
        first: log m/px of the first bin's centre.
        step: from one bin to the next, in log.
    """

    first: float
    step: float


@dataclass(frozen=True)
class SceneCalibration:
    """Parameters from a network's answers to a calibrated density (``research/training/scene_scale/calibrate.py``).

    Attributes:
        temperature: exponent on the geometric mean of a level's tiles.
        doubt: share of the flat density in each level's, so that one that is wrong cannot veto the others.
        levels: exponent on the number of levels: 0 takes their geometric mean, as if each said the same; 1 their
            product, as if each said something else.
        floor: share of the flat density.
        finer: share of a sharp image's density that moves to finer scales, where a place unlike the training data is.
    """

    temperature: float = 1.0
    doubt: float = 0.01
    levels: float = 0.0
    floor: float = 0.02
    finer: float = 0.0


@dataclass(frozen=True)
class Level:
    """Tiles of one resolution.

    Attributes:
        factor: by which the image is reduced.
        places: ``[n, 2]`` left and top of the tiles, ``TILE_PX * factor`` wide, in pixels of the image as it is.
    """

    factor: int
    places: NDArray[np.int64]


def tile_places(width_px: int, height_px: int) -> list[Level]:
    """Spread tiles evenly over an image, at every resolution that still holds one.

    Args:
        width_px: of the image.
        height_px: of the image; where either is less than ``TILE_PX`` there is one level, of a tile that overlaps it.

    Returns:
        The levels, the finest first.
    """
    levels = []
    for factor in FACTORS:
        side = TILE_PX * factor
        if factor > 1 and min(width_px, height_px) < side:
            break
        columns, rows = -(-width_px // side), -(-height_px // side)
        if columns * rows > MOST_TILES:
            columns = int(np.clip(round(np.sqrt(MOST_TILES * width_px / height_px)), 1, min(columns, MOST_TILES)))
            rows = min(rows, MOST_TILES // columns)
        lefts = np.linspace(0, max(0, width_px - side), columns).astype(np.int64)
        tops = np.linspace(0, max(0, height_px - side), rows).astype(np.int64)
        levels.append(Level(factor, np.stack(np.meshgrid(lefts, tops), axis=-1).reshape(-1, 2)))
    return levels


def cut_tiles(image: NDArray[np.uint8], level: Level) -> NDArray[np.uint8]:
    """Cut a level's tiles, averaged over areas; what lies beyond a small image mirrors it.

    Args:
        image: ``[h, w, 3]`` RGB.
        level: of ``tile_places``.

    Returns:
        Pixels ``[n, 3, TILE_PX, TILE_PX]`` uint8, contiguous.
    """
    side = TILE_PX * level.factor
    out = np.empty((len(level.places), 3, TILE_PX, TILE_PX), np.uint8)
    for tile, (left, top) in zip(out, level.places, strict=True):
        part = image[top : top + side, left : left + side]
        down, right = side - part.shape[0], side - part.shape[1]
        if down or right:
            part = np.pad(part, ((0, down), (0, right), (0, 0)), "symmetric")
        if level.factor > 1:
            part = np.asarray(cv2.resize(part, (TILE_PX, TILE_PX), interpolation=cv2.INTER_AREA), np.uint8)
        tile[:] = part.transpose(2, 0, 1)
    return out


def scene_density(
    log_probs: Sequence[NDArray[np.float32]],
    factors: Sequence[int],
    bins: SceneBins,
    calibration: SceneCalibration,
) -> NDArray[np.float64]:
    """Combine what was seen on an image's tiles, as the library does.

    Args:
        log_probs: for each level ``[n_tiles, n_bins]``, natural logarithms.
        factors: of the levels.
        bins: of the network.
        calibration: of the network.

    Returns:
        Probabilities ``[len(GRID)]``, which add up to 1.
    """
    levels = tuple(
        scene_scale.SceneLevel(factor, len(seen), seen.astype(np.float64).mean(axis=0))
        for seen, factor in zip(log_probs, factors, strict=True)
    )
    return scene_scale.scene_density(levels, scene_scale.SceneCalibration(bins.first, bins.step, **asdict(calibration)))


def quantiles(density: NDArray[np.float64], shares: Sequence[float]) -> NDArray[np.float64]:
    """The metres per pixel below which these shares of a density on ``GRID`` lie."""
    below = np.cumsum(density) - 0.5 * density
    return np.asarray(np.exp(np.interp(shares, below / density.sum(), GRID)), np.float64)


def interval(density: NDArray[np.float64]) -> tuple[float, float]:
    """The metres per pixel between which ``INTERVAL`` of a density on ``GRID`` lies, central."""
    low, high = quantiles(density, [(1 - INTERVAL) / 2, (1 + INTERVAL) / 2])
    return float(low), float(high)
