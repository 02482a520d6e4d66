"""Proposals of courts from a small network on reduced images.

The network sees the image at 0.38 to 0.88 m/px, where a court is 27 to 62 px long and its lines are hardly visible.
Matching and fitting of the lines then accept or reject each proposal.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from vehanchor.courts.match import Pose
from vehanchor.courts.template import BASKETBALL, TENNIS
from vehanchor.detection.scheduler import WINDOWED_PIXELS
from vehanchor.errors import ModelContractError
from vehanchor.imagery.tiles import read_preview, read_reduced_window, tile_grid
from vehanchor.models.files import file_cached, read_model
from vehanchor.models.runtime import LoadedModel, Runtime
from vehanchor.models.session import open_session, run_session
from vehanchor.models.zoo import COURTS
from vehanchor.scale.density import quantile

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from vehanchor.detection.scene_scale import SceneScalePrior
    from vehanchor.imagery.raster import Raster

_CELL_PX = 8  # side of the network's cells, and the unit of its lengths: research/training/courts/network.py
_LENGTH_PX = 44.0
_BEST_GSD_M_PER_PX = 0.58  # the middle of its training range: research/training/courts/data.py
_FACTORS = (2, 4, 8, 16)  # one octave of scales each: images of 0.02 to 0.44 m/px
_MOST_PIXELS_ALL_FACTORS = 1_500_000  # up to this image size all factors are searched, whatever the scene-scale prior
_TILE_PX, _STRIDE_PX = 1088, 960  # of the reduced image; tiles overlap by two courts
_LEAST_SHARE = 0.25
_MIN_SIDE_PX = 24
LENGTHS_M = (TENNIS.length_m, BASKETBALL[0].length_m)


class Proposal(NamedTuple):
    """Candidate for a court.

    Attributes:
        which: 0 for tennis, 1 for basketball.
        share: 0..1, score of the network.
        pose: in pixels of the image.
        factor: reduction factor at which the candidate was found.
    """

    which: int
    share: float
    pose: Pose
    factor: int


def coarse_factors(raster: Raster, prior: SceneScalePrior | None) -> list[int]:
    """Choose the reduction factors for the court network.

    For large images the scene-scale prior, if there is one, selects a single factor.

    Args:
        raster: the image.
        prior: scene-scale prior; None without one.

    Returns:
        Factors, the finest first.
    """
    side = min(raster.width_px, raster.height_px)
    factors = [factor for factor in _FACTORS if side // factor >= _MIN_SIDE_PX]
    if prior is None or raster.width_px * raster.height_px <= _MOST_PIXELS_ALL_FACTORS:
        return factors
    median = quantile(prior.density, 0.5)
    return [min(factors, key=lambda factor: abs(math.log(median * factor / _BEST_GSD_M_PER_PX)))] if factors else []


class CourtNetwork(LoadedModel):
    """Network that proposes courts.

    Args:
        path: ONNX file with an input ``tiles`` ``[n, 3, h, w]`` uint8 RGB, sides multiples of 8, and an output
            ``courts`` ``[n, 5, h / 8, w / 8]``: scores of tennis and basketball, cosine and sine of twice the angle,
            log of the length divided by 44 px.
        runtime: how to open it; None for the defaults.

    Raises:
        ModelNotFoundError: there is no such file.
        ModelContractError: the file is not a court network.
    """

    def __init__(self, path: Path, *, runtime: Runtime | None = None) -> None:
        self.path, self.runtime = path, runtime or Runtime()
        self._session = open_session(path, content=read_model(path).content, runtime=self.runtime)
        names = [each.name for each in (*self._session.get_inputs(), *self._session.get_outputs())]
        if names != ["tiles", "courts"]:
            raise ModelContractError(f"{path} has {', '.join(names)}: expected the input tiles and the output courts")

    def propose(self, raster: Raster, factor: int) -> list[Proposal]:
        """Propose courts in an image reduced by a factor; large images are read from the file's overviews if possible.

        Args:
            raster: the image.
            factor: 1 or more.

        Returns:
            Proposals in no order; a court in the overlap of two tiles can occur twice.
        """
        width, height = raster.width_px // factor, raster.height_px // factor
        read = read_reduced_window if raster.width_px * raster.height_px < WINDOWED_PIXELS else read_preview
        found = []
        for window in tile_grid(width, height, tile_px=_TILE_PX, stride_px=_STRIDE_PX):
            pixels = read(raster, window, factor)
            down, right = -pixels.shape[0] % _CELL_PX, -pixels.shape[1] % _CELL_PX
            pixels = np.pad(pixels, ((0, down), (0, right), (0, 0)))
            tile = np.ascontiguousarray(pixels.transpose(2, 0, 1))[None]
            described = f"the court network {self.path} fails on {list(tile.shape)}"
            (seen,) = run_session(self._session, None, {"tiles": tile}, self.runtime, described)
            found += _peaks(seen[0], factor, window.x_px, window.y_px)
        return found


_opened = file_cached(max_models=2)(CourtNetwork)


def load_court_network(runtime: Runtime | None = None) -> CourtNetwork:
    """Load the bundled network once for each runtime, on one thread."""
    # one thread: the network is small, and must not occupy all cores of a single-threaded worker
    chosen = replace(runtime or Runtime(), threads=1)
    return _opened(COURTS, runtime=chosen.idle).under(chosen)


def _peaks(seen: NDArray[np.float32], factor: int, left: int, top: int) -> list[Proposal]:
    """Find the cells of a tile that score above their neighbours; (left, top) is its corner in the reduced image."""
    found = []
    for which, shares in enumerate(seen[:2]):
        highest = cv2.dilate(shares, np.ones((3, 3)))
        for row, column in zip(*np.nonzero((shares >= highest) & (shares >= _LEAST_SHARE)), strict=True):
            cos, sin, log_length = (float(value) for value in seen[2:, row, column])
            length_px = _LENGTH_PX * math.exp(min(max(log_length, -1.0), 1.0)) * factor
            x, y = ((left, top) + (np.array((column, row)) + 0.5) * _CELL_PX) * factor - 0.5
            pose = Pose(float(x), float(y), math.atan2(sin, cos) / 2, length_px / LENGTHS_M[which])
            found.append(Proposal(which, float(shares[row, column]), pose, factor))
    return found
