"""Scene-scale prior: a small network predicts the GSD from tiles of an image.

The network predicts a density of the GSD for a tile of 160 px. It runs on tiles spread over the
image at full resolution and at 1/2, 1/4 and 1/8. Where a tile at full resolution shows only grass,
a reduced one shows houses and roads.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import pydantic.dataclasses
from pydantic import ConfigDict, Field

from vehanchor.errors import ModelContractError
from vehanchor.imagery.raster import Window
from vehanchor.imagery.tiles import read_reduced_window
from vehanchor.models.files import file_cached, read_model
from vehanchor.models.runtime import LoadedModel, Runtime
from vehanchor.models.session import open_session, run_session
from vehanchor.models.zoo import SCENE_SCALE
from vehanchor.scale.defaults import CAR_LENGTH_M
from vehanchor.scale.density import GRID, blurred, flat, shifted

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike, NDArray

    from vehanchor.imagery.raster import Raster

TILE_PX = 160
FACTORS = (1, 2, 4, 8)  # reduction factors of the image
MOST_TILES = 24  # per level
_LEAST_PROBABILITY = 1e-12
_SIZES_LOG_SD = 0.1  # of cars' lengths and of their measurement
_OPEN_LOG_WIDTH = 2.0  # a prior that is flat over this width neither raises nor lowers a score
_MOST_SIZE_ODDS = 2.0  # in either direction, because the prior may be wrong
_BATCH = 8  # tiles per run: 24 take three times the memory and as much time
# few places below this scale are in the training data
_SHARP_GSD_M_PER_PX = 0.15
_SHARP_LOG_WIDTH = 0.15
_FINER_LOG_REACH = 0.8  # by which a new place is finer at most
_Share = Annotated[float, Field(ge=0, lt=1)]


@pydantic.dataclasses.dataclass(frozen=True, config=ConfigDict(allow_inf_nan=False))
class SceneCalibration:
    """Calibration from a network's predictions to a density (``research/training/scene_scale/calibrate.py``).

    Attributes:
        first_log_gsd: natural log of metres per pixel at the first bin's centre.
        log_step: difference between neighbouring bins.
        temperature: exponent on the mean of a level's tiles.
        doubt: outlier probability of a level, so that no level can veto the others.
        levels: power of the number of levels in the exponent on their geometric mean: 0 if the
            levels are fully dependent, 1 if they are independent.
        floor: outlier probability of all levels together.
        finer: probability that a sharp image shows a place unlike the training data, which then
            looks coarser than it is.
    """

    first_log_gsd: float
    log_step: Annotated[float, Field(gt=0)]
    temperature: Annotated[float, Field(gt=0)] = 1.0
    doubt: _Share = 0.0
    levels: float = 0.0
    floor: _Share = 0.02
    finer: _Share = 0.0


@dataclass(frozen=True, eq=False)
class SceneScalePrior:
    """Scene-scale prior of an image from all resolutions.

    Attributes:
        density: ``[g]`` probabilities on ``vehanchor.scale.density.GRID``.
        n_tiles: number of tiles behind it.
    """

    density: NDArray[np.float64]
    n_tiles: int

    @cached_property
    def _size_odds(self) -> NDArray[np.float64]:
        per_log = blurred(self.density, _SIZES_LOG_SD) / (GRID[1] - GRID[0])
        odds = np.log(np.maximum(per_log * _OPEN_LOG_WIDTH, _LEAST_PROBABILITY))
        return np.asarray(np.clip(odds, -_MOST_SIZE_ODDS, _MOST_SIZE_ODDS))

    def scaled(self, ratio: float) -> SceneScalePrior:
        """Move the prior to another image of the same ground, with ``ratio`` times the metres per pixel."""
        return replace(self, density=shifted(self.density, -math.log(ratio)))

    def size_odds(self, lengths_px: ArrayLike) -> NDArray[np.float64]:
        """Compute how well lengths fit a car's length under this prior.

        Args:
            lengths_px: ``[n]`` pixels of the image.

        Returns:
            ``[n]`` log odds from -2 to 2, relative to a prior that is flat over a factor of 7.4;
            -1.2 for a flat prior.
        """
        return np.asarray(
            np.interp(
                np.log(CAR_LENGTH_M / np.asarray(lengths_px, np.float64)), GRID, self._size_odds
            )
        )


def tile_windows(width_px: int, height_px: int) -> list[tuple[int, list[Window]]]:
    """Spread tiles evenly over an image, at every resolution that still holds one.

    Args:
        width_px: width of the image.
        height_px: height of the image. If either side is below 160 px, there is one level with
            smaller tiles.

    Returns:
        Reduction factors and tiles in pixels of the reduced image, the finest first.
    """
    levels = []
    for factor in FACTORS:
        width = width_px // factor
        height = height_px // factor
        if factor > 1 and min(width, height) < TILE_PX:
            break
        columns = -(-width // TILE_PX)
        rows = -(-height // TILE_PX)
        if columns * rows > MOST_TILES:
            columns = int(
                np.clip(round(np.sqrt(MOST_TILES * width / height)), 1, min(columns, MOST_TILES))
            )
            rows = min(rows, MOST_TILES // columns)
        lefts = np.linspace(0, max(0, width - TILE_PX), columns).astype(int)
        tops = np.linspace(0, max(0, height - TILE_PX), rows).astype(int)
        tile = min(TILE_PX, width), min(TILE_PX, height)
        levels.append(
            (factor, [Window(int(left), int(top), *tile) for top in tops for left in lefts])
        )
    return levels


def scene_density(
    levels: Sequence[tuple[int, NDArray[np.float64]]], calibration: SceneCalibration
) -> NDArray[np.float64]:
    """Combine the predictions at all resolutions into one density.

    Each level is mixed with a flat density. The log-probabilities are shifted by the reduction
    factors and averaged. A share of a sharp result moves to finer scales, and the result is mixed
    with the flat density again. The first and the last bin stand for all finer and coarser scales.

    Args:
        levels: reduction factor of each level of an image, and ``[bins]`` mean of its tiles'
            log-probabilities, flat if the tiles disagree; at least one level.
        calibration: calibration of the network.

    Returns:
        Probabilities on ``vehanchor.scale.density.GRID``.
    """
    total = np.zeros(len(GRID))
    for factor, log_probs in levels:
        centres = calibration.first_log_gsd + calibration.log_step * np.arange(len(log_probs))
        seen = np.exp(calibration.temperature * (log_probs - log_probs.max()))
        seen = (1 - calibration.doubt) * seen / seen.sum() + calibration.doubt / len(seen)
        total += np.interp(
            GRID + np.log(factor), centres, np.log(np.maximum(seen, _LEAST_PROBABILITY))
        )
    total *= float(len(levels)) ** (calibration.levels - 1)
    density = np.exp(total - total.max())
    seen = _with_finer(density / density.sum(), calibration.finer)
    return np.asarray((1.0 - calibration.floor) * seen + calibration.floor * flat())


class SceneScaleNetwork(LoadedModel):
    """Network that predicts the GSD of tiles.

    Args:
        path: ONNX file with an input ``tiles`` ``[n, 3, 160, 160]`` uint8 RGB and an output
            ``log_probs`` ``[n, bins]``, and its calibration in the metadata.
        runtime: how to open it; None for the defaults.

    Raises:
        ModelNotFoundError: there is no such file.
        ModelContractError: the file is not a scene-scale network.
    """

    def __init__(self, path: Path, *, runtime: Runtime | None = None) -> None:
        self.path = path
        self.runtime = runtime or Runtime()
        self._session = open_session(path, content=read_model(path).content, runtime=self.runtime)
        names = [each.name for each in (*self._session.get_inputs(), *self._session.get_outputs())]
        if names != ["tiles", "log_probs"]:
            raise ModelContractError(
                f"{path} has {', '.join(names)}: expected the input tiles, the output log_probs"
            )
        self.calibration = _read_calibration(
            path, self._session.get_modelmeta().custom_metadata_map
        )

    def predict(self, raster: Raster) -> SceneScalePrior:
        """Predict the scale of an image from tiles at every resolution.

        Args:
            raster: the image.

        Returns:
            The scene-scale prior.
        """
        levels = []
        n_tiles = 0
        for factor, windows in tile_windows(raster.width_px, raster.height_px):
            tiles = np.stack([read_tile(raster, window, factor) for window in windows])
            described = f"the scene scale network {self.path} fails on {list(tiles.shape)}"
            seen = [
                run_session(
                    self._session,
                    None,
                    feeds={"tiles": tiles[start : start + _BATCH]},
                    runtime=self.runtime,
                    described=described,
                )[0]
                for start in range(0, len(tiles), _BATCH)
            ]
            levels.append((factor, np.concatenate(seen).astype(np.float64).mean(axis=0)))
            n_tiles += len(tiles)
        return SceneScalePrior(scene_density(levels, self.calibration), n_tiles)


_opened = file_cached(max_models=2)(SceneScaleNetwork)


def load_scene_scale(runtime: Runtime | None = None) -> SceneScaleNetwork:
    """Load the bundled network once for each runtime."""
    chosen = runtime or Runtime()
    return _opened(SCENE_SCALE, runtime=chosen.idle).under(chosen)


def _with_finer(density: NDArray[np.float64], chance: float) -> NDArray[np.float64]:
    """Move a share of the density at sharp scales evenly over the finer scales within reach."""
    sharp = 1 / (1 + np.exp((GRID - np.log(_SHARP_GSD_M_PER_PX)) / _SHARP_LOG_WIDTH))
    moving = chance * sharp * density
    reach = round(_FINER_LOG_REACH / (GRID[1] - GRID[0]))
    moved = np.convolve(moving, np.full(reach, 1 / reach))[reach - 1 :]
    mixed = density - moving + moved
    return np.asarray(mixed / mixed.sum())


def read_tile(raster: Raster, window: Window, factor: int) -> NDArray[np.uint8]:
    """Read a tile ``[3, 160, 160]`` of ``tile_windows``; a small image is mirrored beyond its edges."""
    pixels = read_reduced_window(raster, window, factor)
    down = TILE_PX - pixels.shape[0]
    right = TILE_PX - pixels.shape[1]
    if down or right:
        pixels = np.pad(pixels, ((0, down), (0, right), (0, 0)), "symmetric")
    return np.ascontiguousarray(pixels.transpose(2, 0, 1))


def _read_calibration(path: Path, metadata: Mapping[str, str]) -> SceneCalibration:
    try:
        bins, stated = (
            json.loads(metadata[f"vehanchor.scene_{name}"]) for name in ("bins", "calibration")
        )
        return SceneCalibration(*bins, **stated)
    except (KeyError, ValueError, TypeError) as error:
        raise ModelContractError(
            f"{path}: the metadata vehanchor.scene_* cannot be used: {error}"
        ) from None
