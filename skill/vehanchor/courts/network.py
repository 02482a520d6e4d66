"""Court network: a small network that proposes courts in a reduced image.

It sees the image at 0.38 to 0.88 m/px, where a court is 27 to 62 px long and its lines are hardly
visible.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from vehanchor.courts.templates import LENGTHS_M, Pose
from vehanchor.detection.scheduler import WINDOWED_PIXELS
from vehanchor.imagery.tiles import read_preview, read_reduced_window, tile_grid
from vehanchor.models.files import file_cached, read_model
from vehanchor.models.runtime import LoadedModel, Runtime
from vehanchor.models.session import check_tensors, open_session, run_session
from vehanchor.models.zoo import bundled_file
from vehanchor.scale.density import quantile

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from vehanchor.detection.scene_scale import SceneScalePrior
    from vehanchor.imagery.raster import Raster, Window

# Side of the network's cells, and the unit of its lengths: research/training/courts/network.py.
_CELL_PX = 8
_LENGTH_PX = 44.0
# Largest log of a length in that unit.
_MAX_LOG_LENGTH = 1.0
# The middle of the network's training range: research/training/courts/data.py.
_BEST_GSD_M_PER_PX = 0.58
# Reduction factors, one octave of scales each: images of 0.02 to 0.44 m/px.
_FACTORS = (2, 4, 8, 16)
# Up to this image size all factors are searched, whatever the scene-scale prior.
_MAX_PIXELS_ALL_FACTORS = 1_500_000
# Least side of a reduced image.
_MIN_SIDE_PX = 24
# Tiles of the reduced image; they overlap by two courts.
_TILE_PX = 1088
_STRIDE_PX = 960
# Least score of a proposal.
_MIN_SCORE = 0.25


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
    side_px = min(raster.width_px, raster.height_px)
    factors = [factor for factor in _FACTORS if side_px // factor >= _MIN_SIDE_PX]
    is_small = raster.width_px * raster.height_px <= _MAX_PIXELS_ALL_FACTORS
    if not factors or prior is None or is_small:
        return factors
    median_gsd = quantile(prior.density, 0.5)

    def distance_from_training(factor: int) -> float:
        return abs(math.log(median_gsd * factor / _BEST_GSD_M_PER_PX))

    return [min(factors, key=distance_from_training)]


class CourtNetwork(LoadedModel):
    """Network that proposes courts.

    Args:
        path: ONNX file with an input ``tiles`` ``[n, 3, h, w]`` uint8 RGB, sides multiples of 8,
            and an output ``courts`` ``[n, 5, h / 8, w / 8]``: scores of tennis and basketball,
            cosine and sine of twice the angle, log of the length divided by 44 px.
        runtime: how to open it; None for the defaults.

    Raises:
        ModelNotFoundError: there is no such file.
        ModelContractError: the file is not a court network.
    """

    def __init__(self, path: Path, *, runtime: Runtime | None = None) -> None:
        self.path = path
        self.runtime = runtime or Runtime()
        content = read_model(path).content
        self._session = open_session(path, content=content, runtime=self.runtime)
        check_tensors(self._session, path, input_name="tiles", output_name="courts")

    def propose(self, raster: Raster, factor: int) -> list[Proposal]:
        """Propose courts in an image reduced by a factor.

        Large images are read from the file's overviews if possible.

        Args:
            raster: the image.
            factor: 1 or more.

        Returns:
            Proposals in no order; a court in the overlap of two tiles can occur twice.
        """
        width = raster.width_px // factor
        height = raster.height_px // factor
        read = read_reduced_window
        if raster.width_px * raster.height_px >= WINDOWED_PIXELS:
            read = read_preview
        proposals = []
        windows = tile_grid(width, height, tile_px=_TILE_PX, stride_px=_STRIDE_PX)
        for window in windows:
            pixels = read(raster, window, factor)
            answers = self._run(pixels)
            proposals += _peaks(answers, window, factor)
        return proposals

    def _run(self, pixels: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Run the network on a tile ``[h, w, 3]``; return ``[5, rows, columns]`` of its cells."""
        # Whole cells: zeros are added below and on the right.
        height, width, _ = pixels.shape
        down = -height % _CELL_PX
        right = -width % _CELL_PX
        padded = np.pad(pixels, ((0, down), (0, right), (0, 0)))
        channels = padded.transpose(2, 0, 1)
        tile = np.ascontiguousarray(channels)[None]
        (answers,) = run_session(
            self._session,
            None,
            feeds={"tiles": tile},
            runtime=self.runtime,
            described=f"the court network {self.path} fails on {list(tile.shape)}",
        )
        return np.asarray(answers[0])


_opened = file_cached(max_models=2)(CourtNetwork)


def load_court_network(runtime: Runtime | None = None) -> CourtNetwork:
    """Load the bundled network once for each runtime, on one thread.

    The network is small, and must not occupy all cores of a single-threaded worker.
    """
    runtime = replace(runtime or Runtime(), threads=1)
    return _opened(bundled_file("courts"), runtime=runtime.idle).under(runtime)


def _peaks(answers: NDArray[np.float32], window: Window, factor: int) -> list[Proposal]:
    """Find the cells that score above their neighbours.

    Args:
        answers: ``[5, rows, columns]`` of the network.
        window: the tile, in pixels of the reduced image.
        factor: reduction factor of that image.
    """
    proposals = []
    neighbourhood = np.ones((3, 3))
    for which, scores in enumerate(answers[:2]):
        highest = cv2.dilate(scores, neighbourhood)
        is_peak = (scores >= highest) & (scores >= _MIN_SCORE)
        for row, column in np.argwhere(is_peak):
            cos, sin, log_length = answers[2:, row, column].tolist()
            log_length = min(max(log_length, -_MAX_LOG_LENGTH), _MAX_LOG_LENGTH)
            length_px = _LENGTH_PX * math.exp(log_length) * factor
            # The centre of a cell; a pose counts from the centre of the first pixel.
            centre_x = window.x_px + (column + 0.5) * _CELL_PX
            centre_y = window.y_px + (row + 0.5) * _CELL_PX
            pose = Pose(
                x=float(centre_x * factor - 0.5),
                y=float(centre_y * factor - 0.5),
                # The network answers with twice the angle: half a turn changes nothing.
                angle=math.atan2(sin, cos) / 2,
                px_per_m=length_px / LENGTHS_M[which],
            )
            score = float(scores[row, column])
            proposals.append(Proposal(which, score, pose=pose, factor=factor))
    return proposals
