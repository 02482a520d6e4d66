"""Courts of an image: proposed by a small network at low resolution, then matched, fitted and verified by their lines.

The network sees the image at 0.38 to 0.88 m/px, where a court is 27 to 62 px long and its lines are
hardly visible.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from vehanchor.courts.fit import AFFINE, SIMILARITY, fit, pose_matrix, project
from vehanchor.courts.match import BASKETBALL, TENNIS, Pose, match
from vehanchor.detection.scheduler import WINDOWED_PIXELS
from vehanchor.errors import ModelContractError
from vehanchor.imagery.raster import Window
from vehanchor.imagery.tiles import read_preview, read_reduced_window, tile_grid
from vehanchor.models.files import file_cached, read_model
from vehanchor.models.runtime import LoadedModel, Runtime
from vehanchor.models.session import open_session, run_session
from vehanchor.models.zoo import COURTS
from vehanchor.scale.density import quantile

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from vehanchor.courts.fit import Fit
    from vehanchor.courts.match import Template
    from vehanchor.detection.scene_scale import SceneScalePrior
    from vehanchor.imagery.raster import Raster

# Ranges of sizes and places; proposals lie at a court's end as often as at its centre.
_FAR: tuple[NDArray[np.float64], NDArray[np.intp]] = (
    np.arange(-10.0, 11.0) * 0.04,
    np.arange(-27, 28, 3),
)
_THERE: tuple[NDArray[np.float64], NDArray[np.intp]] = np.arange(-1.0, 2.0) * 0.01, np.arange(-1, 2)
_MOST_COURTS = 4
# best proposals to try; fewer if the scale is known
_MOST_PROPOSALS = 20
_MOST_OF_ONE_SIZE = 6
_MOST_REJECTED = 4  # rejected candidates in a row before the search ends
# a court is fitted at the coarsest resolution that makes it this long, if there is one
_FITTED_PX = 220.0
_AROUND = 0.6  # of a court's length: radius for the directions of its lines
# least length of a court; in shorter ones the lines are a pixel or two apart, as in many textures
_LEAST_PX = 60.0
_MATCHED_PX = 72.0  # least length of a court for matching, if the image has that resolution
_MARGIN = 1.5  # half side of the patch, in half diagonals of the court

_WORTH_A_FIT = 0.3
_LEAST_SCORE = 0.55  # the maximum over 232 training images without a court is 0.50
# roofs with grids reached 0.63; straight lines also form grids in yards and car parks
_LEAST_COVERAGE = 0.68
_SEEN_ARCS = 0.5
_MOST_DISTORTION = 0.06
_QUARTER = math.pi / 2
_BINS = 45  # of a quarter turn: 2 degrees each
_SMOOTH_PX = 1.2  # the pixel steps of a thin line have spurious directions
# in Scharr sums, about ten grey levels: one shadow's edge must not outweigh all painted lines
_CLEAREST = 160.0
# share of the patch that is texture and noise; rounded grey levels have spurious directions
_NO_EDGE = 0.7
_SECOND = 0.8  # share of the strongest direction that a second one needs
_APART_BINS = 5
# side of the network's cells, and the unit of its lengths: research/training/courts/network.py
_CELL_PX = 8
_LENGTH_PX = 44.0
_BEST_GSD_M_PER_PX = 0.58  # the middle of its training range: research/training/courts/data.py
_FACTORS = (2, 4, 8, 16)  # one octave of scales each: images of 0.02 to 0.44 m/px
# up to this image size all factors are searched, whatever the scene-scale prior
_MOST_PIXELS_ALL_FACTORS = 1_500_000
# of the reduced image; tiles overlap by two courts
_TILE_PX = 1088
_STRIDE_PX = 960
_LEAST_SHARE = 0.25
_MIN_SIDE_PX = 24
LENGTHS_M = (TENNIS.length_m, BASKETBALL[0].length_m)


class _Patch(NamedTuple):
    """Grey levels around a court, reduced by ``factor``; its first pixel is at (left, top) of the reduced image."""

    grey: NDArray[np.float32]
    factor: int
    left: int
    top: int

    def inside(self, pose: Pose) -> Pose:
        """Convert a pose from the image to the patch."""
        x, y = ((value + 0.5) / self.factor - 0.5 for value in (pose.x, pose.y))
        return Pose(x - self.left, y - self.top, pose.angle, pose.px_per_m / self.factor)

    def in_image(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert points from the patch (0 is a pixel's centre) to the image (0 is its left and upper edge)."""
        return np.asarray((points + (self.left, self.top) + 0.5) * self.factor)

    def outside(self, pose: Pose) -> Pose:
        """Convert a pose from the patch to the image."""
        x, y = (
            (value + 0.5) * self.factor - 0.5 for value in (pose.x + self.left, pose.y + self.top)
        )
        return Pose(x, y, pose.angle, pose.px_per_m * self.factor)


class _Match(NamedTuple):
    """Match of a game's template with a patch: score, pose, and the game's templates, the matched one first."""

    score: float
    patch: _Patch
    pose: Pose
    game: tuple[Template, ...]


def find_courts(
    raster: Raster, prior: SceneScalePrior | None = None, runtime: Runtime | None = None
) -> list[Court]:
    """Find and measure the courts that lie completely inside an image taken at nadir.

    Args:
        raster: the image.
        prior: scene-scale prior; None without one.
        runtime: of the network that proposes courts; None for the defaults.

    Returns:
        At most four courts, the highest score first. Half hidden courts and courts at the image's
        edge are left out.
    """
    network = load_court_network(runtime)
    factors = coarse_factors(raster, prior)
    proposals = [each for factor in factors for each in network.propose(raster, factor)]
    return courts_among(raster, proposals, n_sizes=len(factors))


def courts_among(raster: Raster, proposals: Sequence[Proposal], *, n_sizes: int = 1) -> list[Court]:
    """Measure the courts among proposals; see ``find_courts``.

    Args:
        raster: the image.
        proposals: in no order.
        n_sizes: number of reduction factors that were searched.
    """
    best = islice(_distinct(proposals), _MOST_OF_ONE_SIZE if n_sizes == 1 else _MOST_PROPOSALS)
    matches = [each for proposal in best for each in _matches(raster, proposal)]
    found: list[Court] = []
    rejected = 0
    for one in sorted(matches, key=lambda each: -each.score):
        if rejected == _MOST_REJECTED or len(found) == _MOST_COURTS:
            break
        if any(_lies_in(one.patch.outside(one.pose)[:2], court) for court in found):
            continue
        court = _measured(raster, one)
        rejected = 0 if court else rejected + 1
        if court is not None and not any(
            _lies_in(court.corners.mean(axis=0).tolist(), other) for other in found
        ):
            found.append(court)
    return sorted(found, key=lambda court: -court.score)


def _distinct(proposals: Sequence[Proposal]) -> Iterator[Proposal]:
    """Yield proposals by falling score, without those within a quarter court length of a better one of like size.

    This is lazy because large images have thousands of proposals and the first few suffice.
    """
    kept: list[Proposal] = []
    for one in sorted(proposals, key=lambda each: -each.share):
        near = TENNIS.length_m / 4 * one.pose.px_per_m
        if not any(
            other.factor == one.factor
            and math.hypot(one.pose.x - other.pose.x, one.pose.y - other.pose.y) < near
            for other in kept
        ):
            kept.append(one)
            yield one


def _matches(raster: Raster, proposal: Proposal) -> list[_Match]:
    """Match the templates of all games near a proposal, the best first; empty if there are too few lines."""
    games = ((TENNIS,), BASKETBALL)[:: -1 if proposal.which else 1]
    firsts = [game[0] for game in games]  # the first template represents its game in the search
    length_px = LENGTHS_M[proposal.which] * proposal.pose.px_per_m
    # the largest that still shows the lines
    factor = 2 ** max(0, math.floor(math.log2(length_px / _MATCHED_PX)))
    patch = _read(raster, proposal.pose, firsts[0], factor)
    start = patch.inside(proposal.pose)
    turned = axes(patch.grey, start.x, start.y, _AROUND * firsts[0].length_m * start.px_per_m)
    angles = [axis + quarter for axis in turned for quarter in (0.0, math.pi / 2)]
    matched = match(patch.grey, firsts, start, *_FAR, angles)
    matches = [
        _Match(score, patch, pose=pose, game=game)
        for (score, pose), game in zip(matched, games, strict=True)
    ]
    return sorted(
        (each for each in matches if each.score >= _WORTH_A_FIT), key=lambda each: -each.score
    )


def _measured(raster: Raster, found: _Match) -> Court | None:
    """Measure the court near a match with the game's best template; None if the lines do not support it."""
    _, patch, pose, templates = found
    first = fit(patch.grey, templates[0], pose_matrix(pose), SIMILARITY)
    if templates[0].length_m * first.px_per_m * patch.factor < _LEAST_PX:
        return None
    there = _pose(first.matrix)
    score, pose = max(
        match(patch.grey, templates, there, *_THERE, [there.angle]), key=lambda each: each[0]
    )
    if score < _LEAST_SCORE:
        return None
    fits = [(kind, *_fitted(raster, kind, patch=patch, pose=pose)) for kind in templates]
    template, seen, patch = max(fits, key=lambda each: each[1].coverage)
    corners = patch.in_image(project(seen.matrix, template.outline))
    if (corners < 0).any() or (corners > (raster.width_px, raster.height_px)).any():
        return None
    arcs = seen.line_coverage[len(template.lines) :]
    if (
        seen.coverage < _LEAST_COVERAGE
        or (len(arcs) and arcs.mean() < _SEEN_ARCS)
        or not math.isfinite(seen.log_sd)
    ):
        return None
    if not fit(patch.grey, template, seen.matrix, AFFINE).distortion <= _MOST_DISTORTION:
        return None
    gsd = float(1.0 / (seen.px_per_m * patch.factor))
    return Court(
        template.kind, corners, template.length_m, template.width_m, gsd, seen.log_sd, score
    )


def _fitted(raster: Raster, template: Template, patch: _Patch, pose: Pose) -> tuple[Fit, _Patch]:
    """Fit at the resolution of the match, then at finer ones while the image has more pixels."""
    seen = fit(patch.grey, template, pose_matrix(pose), SIMILARITY)
    while patch.factor > 1 and template.length_m * seen.px_per_m < _FITTED_PX:
        finer = _read(raster, patch.outside(_pose(seen.matrix)), template, patch.factor // 2)
        seen = fit(
            finer.grey,
            template,
            pose_matrix(finer.inside(patch.outside(_pose(seen.matrix)))),
            SIMILARITY,
        )
        patch = finer
    return seen, patch


def _read(raster: Raster, pose: Pose, template: Template, factor: int) -> _Patch:
    """Read the patch that covers the whole search range of a court, clipped to the image."""
    half = (
        math.hypot(template.length_m, template.width_m) / 2 * pose.px_per_m / factor * _MARGIN
        + _FAR[1][-1]
    )
    x = (pose.x + 0.5) / factor
    y = (pose.y + 0.5) / factor
    width = raster.width_px // factor
    height = raster.height_px // factor
    left, top = (
        int(np.clip(value - half, 0, size - 1)) for value, size in ((x, width), (y, height))
    )
    right, bottom = (
        int(np.clip(value + half, low + 1, size))
        for value, low, size in ((x, left, width), (y, top, height))
    )
    pixels = read_reduced_window(
        raster, Window(left, top, width_px=right - left, height_px=bottom - top), factor
    )
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    return _Patch(np.asarray(grey, np.float32), factor, left=left, top=top)


def _pose(matrix: NDArray[np.float64]) -> Pose:
    """Convert a similarity matrix to a pose."""
    (a, _, x), (c, _, y) = matrix[:2]
    return Pose(float(x), float(y), math.atan2(c, a), math.hypot(a, c))


def _lies_in(centre: Sequence[float], court: Court) -> bool:
    """Test whether a point lies in the central part of a court."""
    corners = court.corners - court.corners.mean(axis=0)
    outline = np.asarray(court.corners.mean(axis=0) + 0.6 * corners, np.float32)
    return cv2.pointPolygonTest(outline, tuple(centre), measureDist=False) >= 0


def axes(grey: NDArray[np.float32], x: float, y: float, radius: float) -> list[float]:
    """Find the possible orientations of a rectangle of lines from the gradients around a point.

    Args:
        grey: ``[h, w]`` grey levels.
        x: column of the point (0 is the centre of the first pixel).
        y: row of the point.
        radius: radius of the neighbourhood, pixels.

    Returns:
        One or two angles, radians from 0 to a quarter turn, the strongest first; each includes its
        perpendicular.
    """
    rows, columns = np.ogrid[: grey.shape[0], : grey.shape[1]]
    near = (columns - x) ** 2 + (rows - y) ** 2 < radius**2
    smoothed = cv2.GaussianBlur(grey, (0, 0), _SMOOTH_PX)
    across, down = (
        np.asarray(cv2.Scharr(smoothed, cv2.CV_32F, *order))[near] for order in ((1, 0), (0, 1))
    )
    steepness = np.hypot(across, down)
    clear = steepness > np.quantile(steepness, _NO_EDGE)
    weights = np.minimum(steepness[clear], _CLEAREST)
    turned = np.arctan2(down[clear], across[clear]) % _QUARTER
    cells = (turned / _QUARTER * _BINS).astype(np.intp) % _BINS
    counts = np.bincount(cells, weights, _BINS)
    smooth = (np.roll(counts, 1) + 2 * counts + np.roll(counts, -1)) / 4
    found: list[float] = []
    left = smooth.copy()
    while len(found) < 2:
        peak = int(left.argmax())
        if found and left[peak] < _SECOND * smooth.max():
            break
        before = smooth[peak - 1]
        top = smooth[peak]
        after = smooth[(peak + 1) % _BINS]
        bend = before - 2 * top + after
        shift = (before - after) / (2 * bend) if bend < 0 else 0.0
        found.append((peak + 0.5 + shift) * _QUARTER / _BINS)
        left[(peak + np.arange(-_APART_BINS, _APART_BINS + 1)) % _BINS] = 0.0
    return found


@dataclass(frozen=True, eq=False)
class Court:
    """Court that was found and measured in an image.

    Attributes:
        kind: ``tennis``, ``basketball_fiba``, ``basketball_nba`` or ``basketball_ncaa``.
        corners: ``[4, 2]`` corners of its outline, pixels of the image (0 is the left and upper
            edge); the first two bound a long side.
        length_m: length of the long sides by the rules of the game.
        width_m: length of the short sides by the rules of the game.
        gsd_m_per_px: GSD from its area.
        log_sd: standard deviation of the GSD's logarithm from the pixels alone.
        score: match of the template with the lines, at most 1.
    """

    kind: str
    corners: NDArray[np.float64]
    length_m: float
    width_m: float
    gsd_m_per_px: float
    log_sd: float
    score: float


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
    return (
        [min(factors, key=lambda factor: abs(math.log(median * factor / _BEST_GSD_M_PER_PX)))]
        if factors
        else []
    )


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
        self._session = open_session(path, content=read_model(path).content, runtime=self.runtime)
        names = [each.name for each in (*self._session.get_inputs(), *self._session.get_outputs())]
        if names != ["tiles", "courts"]:
            raise ModelContractError(
                f"{path} has {', '.join(names)}: expected the input tiles and the output courts"
            )

    def propose(self, raster: Raster, factor: int) -> list[Proposal]:
        """Propose courts in an image reduced by a factor; large images are read from the file's overviews if possible.

        Args:
            raster: the image.
            factor: 1 or more.

        Returns:
            Proposals in no order; a court in the overlap of two tiles can occur twice.
        """
        width = raster.width_px // factor
        height = raster.height_px // factor
        read = (
            read_reduced_window
            if raster.width_px * raster.height_px < WINDOWED_PIXELS
            else read_preview
        )
        found = []
        for window in tile_grid(width, height, tile_px=_TILE_PX, stride_px=_STRIDE_PX):
            pixels = read(raster, window, factor)
            down = -pixels.shape[0] % _CELL_PX
            right = -pixels.shape[1] % _CELL_PX
            pixels = np.pad(pixels, ((0, down), (0, right), (0, 0)))
            tile = np.ascontiguousarray(pixels.transpose(2, 0, 1))[None]
            described = f"the court network {self.path} fails on {list(tile.shape)}"
            (seen,) = run_session(
                self._session,
                None,
                feeds={"tiles": tile},
                runtime=self.runtime,
                described=described,
            )
            found += _peaks(seen[0], factor, left=window.x_px, top=window.y_px)
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
        for row, column in zip(
            *np.nonzero((shares >= highest) & (shares >= _LEAST_SHARE)), strict=True
        ):
            cos, sin, log_length = (float(value) for value in seen[2:, row, column])
            length_px = _LENGTH_PX * math.exp(min(max(log_length, -1.0), 1.0)) * factor
            x, y = ((left, top) + (np.array((column, row)) + 0.5) * _CELL_PX) * factor - 0.5
            pose = Pose(float(x), float(y), math.atan2(sin, cos) / 2, length_px / LENGTHS_M[which])
            found.append(Proposal(which, float(shares[row, column]), pose=pose, factor=factor))
    return found
