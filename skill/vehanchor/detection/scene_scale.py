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
from typing import TYPE_CHECKING, Annotated, TypeAlias

import numpy as np
import pydantic.dataclasses
from pydantic import ConfigDict, Field

from vehanchor.errors import ModelContractError
from vehanchor.imagery.raster import Window
from vehanchor.imagery.tiles import read_reduced_window
from vehanchor.models.files import file_cached, read_model
from vehanchor.models.runtime import LoadedModel, Runtime
from vehanchor.models.session import check_tensors, open_session, run_session
from vehanchor.models.zoo import bundled_file
from vehanchor.scale.defaults import CAR_LENGTH_M
from vehanchor.scale.density import GRID, blurred, flat, quantile, shifted

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import ArrayLike, NDArray

    from vehanchor.imagery.raster import Raster
    from vehanchor.scale.density import Density

    Tiles: TypeAlias = NDArray[np.uint8]
    """``[n, 3, 160, 160]`` RGB."""

    LevelTiles: TypeAlias = tuple[int, list[Window]]
    """Reduction factor of a level, and its tiles in pixels of the reduced image."""

    LevelPrediction: TypeAlias = tuple[int, NDArray[np.float64]]
    """Reduction factor of a level, and ``[bins]`` mean of its tiles' log-probabilities."""

TILE_PX = 160
# Reduction factors of the levels.
FACTORS = (1, 2, 4, 8)
# Largest number of tiles of a level.
MAX_TILES = 24
# Tiles per run: 24 take three times the memory and as much time.
_BATCH = 8
_MIN_PROBABILITY = 1e-12

# Standard deviation of the log of cars' lengths, and of their measurement.
_SIZES_LOG_SD = 0.1
# A prior that is flat over this width, in log terms, neither raises nor lowers a score.
_NEUTRAL_LOG_WIDTH = 2.0
# Largest size odds in either direction, because the prior may be wrong.
_MAX_SIZE_ODDS = 2.0

# GSD below which the training data have few places, and the width of the transition.
_SHARP_GSD_M_PER_PX = 0.15
_SHARP_LOG_WIDTH = 0.15
# Largest difference, in log GSD, by which a new place is finer than it looks.
_FINER_LOG_REACH = 0.8
# Sharp ground without towns, such as fields and lawns, resembles little in training: the prior is
# wide there, and too coarse. From a half-width of its central 68 % of about 0.42, in log GSD, a
# further share of the density moves to finer scales. Heads fitted to the network's features with
# each place left out: below 0.06 m/px, the rms of the error over the stated half-width falls from
# 1.5 to 1.1 for `chia`, and from 1.5 to 1.0 for `bergamo`; photographs of towns (`fuji`,
# `mashiki`) keep their half-width of 0.24 and 0.3. A distance in the features
# (Mahalanobis) predicts the error less well: its correlation is 0.16, that of the width 0.56.
_WIDE_LOG_SD = 0.42
_WIDE_LOG_WIDTH = 0.06
_FINER_IF_WIDE = 0.6
_FINER_IF_WIDE_LOG_REACH = 1.0
# A picture that resembles nothing in training, such as one of water, has a density that is wider
# still, and often wrong. From a half-width of about 0.7 on, up to half of it is flat. With each
# place left out, the rms of the error over the stated half-width falls from 2.2 to 1.1 for 29
# photographs of a port with much water (`estonia_port`), and below 0.06 m/px from 1.17 to 1.04 for
# `chia` (123) and from 1.07 to 1.03 for `bergamo` (23); for towns it stays. The limit was chosen on
# the same places.
_UNKNOWN_LOG_SD = 0.7
_UNKNOWN_LOG_WIDTH = 0.05
_FLAT_IF_UNKNOWN = 0.5
# Standard deviation of the log GSD that a place adds and that none of its tiles shows, such as
# houses that are smaller than elsewhere. With each place left out, and counted by photograph, the
# rms of the error over the stated half-width falls from 1.28 to 1.16 for `banepa`, from 1.24 to
# 1.21 for crops of `bergamo` and from 1.25 to 1.14 for `ucm`. With 0.12 it is 1.12, 1.20 and 1.11,
# and false heights in towns are believed more often: research/results/notes.md has other ways, too.
_PLACE_LOG_SD = 0.1
# Quantiles that hold the central 68 %.
_CENTRAL = (0.16, 0.84)
_Share = Annotated[float, Field(ge=0, lt=1)]


@pydantic.dataclasses.dataclass(frozen=True, config=ConfigDict(allow_inf_nan=False))
class SceneCalibration:
    """Calibration from a network's predictions to a density.

    It is fitted by ``research/training/scene_scale/calibrate.py``.

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

    density: Density
    n_tiles: int

    @cached_property
    def _size_odds(self) -> NDArray[np.float64]:
        """``[g]`` log odds on the grid: the density of car lengths over that of a neutral prior."""
        grid_step = GRID[1] - GRID[0]
        density_per_log = blurred(self.density, _SIZES_LOG_SD) / grid_step
        ratios = density_per_log * _NEUTRAL_LOG_WIDTH
        odds = np.log(np.maximum(ratios, _MIN_PROBABILITY))
        limited = np.clip(odds, -_MAX_SIZE_ODDS, _MAX_SIZE_ODDS)
        return np.asarray(limited)

    def scaled(self, ratio: float) -> SceneScalePrior:
        """Move the prior to an image of the same ground with ``ratio`` times its GSD."""
        density = shifted(self.density, -math.log(ratio))
        return replace(self, density=density)

    def size_odds(self, lengths_px: ArrayLike) -> NDArray[np.float64]:
        """Compute how well lengths fit a car's length under this prior.

        Args:
            lengths_px: ``[n]`` pixels of the image.

        Returns:
            ``[n]`` log odds from -2 to 2, relative to a prior that is flat over a factor of 7.4;
            -1.2 for a flat prior.
        """
        # The GSD at which each length is that of a typical car.
        lengths = np.asarray(lengths_px, np.float64)
        log_gsds = np.log(CAR_LENGTH_M / lengths)
        odds = np.interp(log_gsds, GRID, self._size_odds)
        return np.asarray(odds)


def tile_windows(width_px: int, height_px: int) -> list[LevelTiles]:
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
        columns, rows = _grid_shape(width, height)
        lefts = _tile_starts(width, columns)
        tops = _tile_starts(height, rows)
        size = min(TILE_PX, width), min(TILE_PX, height)
        windows = [Window(left, top, *size) for top in tops for left in lefts]
        levels.append((factor, windows))
    return levels


def _tile_starts(side_px: int, n_tiles: int) -> list[int]:
    """Spread the first pixels of tiles evenly over a side of the image."""
    last = max(0, side_px - TILE_PX)
    positions = np.linspace(0, last, n_tiles)
    starts: list[int] = positions.astype(int).tolist()
    return starts


def _grid_shape(width_px: int, height_px: int) -> tuple[int, int]:
    """Choose the numbers of columns and rows of a level's tiles.

    Tiles cover the level if few are enough; otherwise they are spread in its proportions.
    """
    columns = -(-width_px // TILE_PX)
    rows = -(-height_px // TILE_PX)
    if columns * rows <= MAX_TILES:
        return columns, rows
    spread_columns = round(np.sqrt(MAX_TILES * width_px / height_px))
    max_columns = min(columns, MAX_TILES)
    columns = min(max(spread_columns, 1), max_columns)
    rows = min(rows, MAX_TILES // columns)
    return columns, rows


def scene_density(levels: Sequence[LevelPrediction], calibration: SceneCalibration) -> Density:
    """Combine the predictions at all resolutions into one density.

    Each level is mixed with a flat density. The log-probabilities are shifted by the reduction
    factors and averaged. A share of a sharp result moves to finer scales, a larger one of a wide
    result, and the result is mixed with the flat density again, more so if it is very wide. Last,
    it is blurred by the error of the place. The first and the last bin stand for all finer and
    coarser scales.

    Args:
        levels: reduction factor of each level of an image, and ``[bins]`` mean of its tiles'
            log-probabilities, flat if the tiles disagree; at least one level.
        calibration: calibration of the network.

    Returns:
        Probabilities on ``vehanchor.scale.density.GRID``.
    """
    total = np.zeros(len(GRID))
    for factor, log_probs in levels:
        bins = len(log_probs)
        # Temperature scaling, then a mixture with a flat density: no level can veto the others.
        doubt = calibration.doubt
        below_highest = log_probs - log_probs.max()
        probs = np.exp(calibration.temperature * below_highest)
        probs = (1 - doubt) * probs / probs.sum() + doubt / bins
        log_probs_mixed = np.log(np.maximum(probs, _MIN_PROBABILITY))
        # A pixel of the reduced image is ``factor`` times as large as one of the image.
        steps = calibration.log_step * np.arange(bins)
        centres = calibration.first_log_gsd + steps
        log_gsds_of_level = GRID + np.log(factor)
        total += np.interp(log_gsds_of_level, centres, log_probs_mixed)
    # Power of the geometric mean: 1 for dependent levels, their number for independent ones.
    total *= float(len(levels)) ** (calibration.levels - 1)
    density = np.exp(total - total.max())
    density = _with_finer(density / density.sum(), calibration.finer, reach=_FINER_LOG_REACH)
    wide_share = _share_above(_half_width(density), _WIDE_LOG_SD, width=_WIDE_LOG_WIDTH)
    finer_share = _FINER_IF_WIDE * wide_share
    density = _with_finer(density, finer_share, reach=_FINER_IF_WIDE_LOG_REACH)
    unknown_share = _share_above(_half_width(density), _UNKNOWN_LOG_SD, width=_UNKNOWN_LOG_WIDTH)
    for flat_share in (_FLAT_IF_UNKNOWN * unknown_share, calibration.floor):
        density = (1.0 - flat_share) * density + flat_share * flat()
    return blurred(density, _PLACE_LOG_SD)


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
        content = read_model(path).content
        self._session = open_session(path, content=content, runtime=self.runtime)
        check_tensors(self._session, path, input_name="tiles", output_name="log_probs")
        metadata = self._session.get_modelmeta().custom_metadata_map
        self.calibration = _read_calibration(path, metadata)

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
            log_probs = self._log_probs(tiles).astype(np.float64)
            levels.append((factor, log_probs.mean(axis=0)))
            n_tiles += len(tiles)
        density = scene_density(levels, self.calibration)
        return SceneScalePrior(density, n_tiles)

    def _log_probs(self, tiles: Tiles) -> NDArray[np.float32]:
        """Predict the log-probabilities ``[n, bins]`` of tiles ``[n, 3, 160, 160]``."""
        described = f"the scene scale network {self.path} fails on {list(tiles.shape)}"
        parts = []
        for start in range(0, len(tiles), _BATCH):
            (log_probs,) = run_session(
                self._session,
                None,
                feeds={"tiles": tiles[start : start + _BATCH]},
                runtime=self.runtime,
                described=described,
            )
            parts.append(log_probs)
        return np.concatenate(parts)


_opened = file_cached(max_models=2)(SceneScaleNetwork)


def load_scene_scale(runtime: Runtime | None = None) -> SceneScaleNetwork:
    """Load the bundled network once for each runtime."""
    runtime = runtime or Runtime()
    return _opened(bundled_file("scene-scale"), runtime=runtime.idle).under(runtime)


def _half_width(density: Density) -> float:
    """Compute half the width, in log GSD, of the central 68 % of a density ``[g]``."""
    low_share, high_share = _CENTRAL
    low = math.log(quantile(density, low_share))
    high = math.log(quantile(density, high_share))
    return (high - low) / 2


def _share_above(half_width: float, limit: float, *, width: float) -> float:
    """Compute a share that rises smoothly from 0 to 1 around a limit.

    Args:
        half_width: half the width of a density.
        limit: half-width at which the share is 0.5.
        width: width of the transition.
    """
    return 1 / (1 + math.exp((limit - half_width) / width))


def _with_finer(density: Density, chance: float, *, reach: float) -> Density:
    """Move a share of the density at sharp scales evenly over finer scales.

    Args:
        density: ``[g]`` probabilities.
        chance: the share.
        reach: largest difference in log GSD.
    """
    log_excess = GRID - np.log(_SHARP_GSD_M_PER_PX)
    sharp = 1 / (1 + np.exp(log_excess / _SHARP_LOG_WIDTH))
    moving = chance * sharp * density
    # The convolution spreads each cell over coarser scales; the offset turns them to finer ones.
    grid_step = GRID[1] - GRID[0]
    n_cells = round(reach / grid_step)
    kernel = np.full(n_cells, 1 / n_cells)
    moved = np.convolve(moving, kernel)[n_cells - 1 :]
    mixed = density - moving + moved
    return np.asarray(mixed / mixed.sum())


def read_tile(raster: Raster, window: Window, factor: int) -> NDArray[np.uint8]:
    """Read a tile ``[3, 160, 160]`` of ``tile_windows``.

    A small image is mirrored beyond its edges.
    """
    pixels = read_reduced_window(raster, window, factor)
    height, width, _ = pixels.shape
    down = TILE_PX - height
    right = TILE_PX - width
    if down or right:
        borders = ((0, down), (0, right), (0, 0))
        pixels = np.pad(pixels, borders, "symmetric")
    return np.ascontiguousarray(pixels.transpose(2, 0, 1))


def _read_calibration(path: Path, metadata: Mapping[str, str]) -> SceneCalibration:
    """Read the calibration from the metadata.

    Raises:
        ModelContractError: an entry is missing or invalid.
    """
    try:
        first_log_gsd, log_step = json.loads(metadata["vehanchor.scene_bins"])
        fitted = json.loads(metadata["vehanchor.scene_calibration"])
        return SceneCalibration(first_log_gsd, log_step, **fitted)
    except (KeyError, ValueError, TypeError) as error:
        raise ModelContractError(
            f"{path}: the metadata vehanchor.scene_* cannot be used: {error}"
        ) from None
