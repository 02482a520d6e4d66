"""Courts of an image: proposed by a network, then matched, fitted and verified by their lines.

1. The court network proposes poses in the reduced image.
2. Around a proposal, the templates of all games are matched with the lines.
3. The best matches are fitted at finer resolutions, up to a fraction of a pixel.
4. A court counts if its lines, its arcs and its shape are as the rules of the game demand.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import islice
from operator import itemgetter
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import cv2
import numpy as np

from vehanchor.courts.fit import AFFINE, SIMILARITY, fit, pose_matrix, project
from vehanchor.courts.match import match
from vehanchor.courts.network import coarse_factors, load_court_network
from vehanchor.courts.surplus import surplus_share
from vehanchor.courts.templates import BASKETBALL, LENGTHS_M, TENNIS, Pose
from vehanchor.imagery.raster import Window
from vehanchor.imagery.tiles import read_reduced_window

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from vehanchor.courts.fit import Fit
    from vehanchor.courts.network import Proposal
    from vehanchor.courts.templates import Template
    from vehanchor.detection.scene_scale import SceneScalePrior
    from vehanchor.imagery.raster import Raster
    from vehanchor.models.runtime import Runtime

    GreyImage: TypeAlias = NDArray[np.float32]
    """``[h, w]`` grey levels."""

    Points: TypeAlias = NDArray[np.float64]
    """``[n, 2]`` points in pixels."""

    Gradients: TypeAlias = NDArray[np.float32]
    """``[n]`` differences of grey levels along an axis, Scharr sums."""

# Search around a proposal: log sizes, and pixels to either side. Proposals lie at a court's end as
# often as at its centre.
_WIDE_LOG_SIZES: NDArray[np.float64] = np.arange(-10.0, 11.0) * 0.04
_WIDE_PLACES: NDArray[np.intp] = np.arange(-27, 28, 3)
# Search around a fitted court.
_CLOSE_LOG_SIZES: NDArray[np.float64] = np.arange(-1.0, 2.0) * 0.01
_CLOSE_PLACES: NDArray[np.intp] = np.arange(-1, 2)

_MAX_COURTS = 4
# Best proposals to try; fewer if the scale is known.
_MAX_PROPOSALS = 20
_MAX_PROPOSALS_OF_ONE_SIZE = 6
# Rejected candidates in a row before the search ends.
_MAX_REJECTED = 4
# Least length of a court, pixels. In shorter ones the lines are a pixel or two apart, as in many
# textures.
_MIN_PX = 60.0
# Least length of a court for matching, if the image has that resolution.
_MATCHED_PX = 72.0
# A court is fitted at the coarsest resolution that makes it this long, if there is one.
_FITTED_PX = 220.0
# Radius of the neighbourhood that shows the directions of a court's lines, in court lengths.
_AROUND = 0.6
# Half side of a patch, in half diagonals of the court.
_MARGIN = 1.5
# A proposal within this part of a court's length of a better one is the same court.
_SAME_COURT = 1 / 4
# Part of a court, around its centre, in which the centre of another court cannot lie.
_CENTRAL = 0.6

# Least score of a match that is fitted.
_MIN_MATCH_SCORE = 0.3
# Least score of a court; the maximum over 232 training images without a court is 0.50.
_MIN_SCORE = 0.55
# Least coverage of the lines: roofs with grids reached 0.63. Straight lines form grids in yards and
# car parks, too, so the arcs of a basketball court must be covered.
_MIN_COVERAGE = 0.68
_MIN_ARC_COVERAGE = 0.5
# Largest contrast of a line where a court has none, over that of its own lines. In photographs, 162
# tennis courts have at most 0.67; the lanes of a freeway that look like a court have 0.75. Drawn
# roofs with seams that look like one have 0.95 and more.
_MAX_SURPLUS = 0.7
# Largest log stretch or shear of an affine fit.
_MAX_DISTORTION = 0.06

# Histogram of the directions of gradients: bins of a quarter turn, 2 degrees each.
_QUARTER = math.pi / 2
_BINS = 45
# Smoothing, pixels: the pixel steps of a thin line have spurious directions.
_SMOOTH_PX = 1.2
# Largest weight of a gradient, in Scharr sums: about ten grey levels. The edge of one shadow must
# not outweigh all painted lines.
_MAX_STEEPNESS = 160.0
# Share of the patch that is texture and noise; rounded grey levels have spurious directions.
_TEXTURE_SHARE = 0.7
# Share of the strongest direction that a second one needs, and its least distance, bins.
_SECOND_SHARE = 0.8
_APART_BINS = 5


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
        coverage: 0..1, share of the lines' length found where it should be.
    """

    kind: str
    corners: Points
    length_m: float
    width_m: float
    gsd_m_per_px: float
    log_sd: float
    score: float
    coverage: float

    @property
    def quality(self) -> float:
        """How well the lines fit, at most 1."""
        return self.score * self.coverage

    @property
    def centre(self) -> tuple[float, float]:
        """Mean of the corners."""
        mean = self.corners.mean(axis=0)
        return float(mean[0]), float(mean[1])


class _Patch(NamedTuple):
    """Patch of an image around a court.

    Attributes:
        grey: ``[h, w]`` grey levels.
        factor: reduction factor of the image.
        left: column of the first pixel in the reduced image.
        top: row of the first pixel in the reduced image.
    """

    grey: GreyImage
    factor: int
    left: int
    top: int

    def pose_in_patch(self, pose: Pose) -> Pose:
        """Convert a pose from the image to the patch."""
        x = (pose.x + 0.5) / self.factor - 0.5
        y = (pose.y + 0.5) / self.factor - 0.5
        return Pose(
            x - self.left,
            y - self.top,
            angle=pose.angle,
            px_per_m=pose.px_per_m / self.factor,
        )

    def pose_in_image(self, pose: Pose) -> Pose:
        """Convert a pose from the patch to the image."""
        column = pose.x + self.left
        row = pose.y + self.top
        x = (column + 0.5) * self.factor - 0.5
        y = (row + 0.5) * self.factor - 0.5
        return Pose(x, y, pose.angle, pose.px_per_m * self.factor)

    def points_in_image(self, points: Points) -> Points:
        """Convert points from the patch to the image.

        In the patch, 0 is the centre of the first pixel; in the image, its left and upper edge.
        """
        corner = (self.left, self.top)
        from_edge = points + corner + 0.5
        return np.asarray(from_edge * self.factor)


class _Match(NamedTuple):
    """Match of a game's template with a patch.

    Attributes:
        score: score of the match, at most 1.
        patch: the patch.
        pose: pose of the court in the patch.
        game: templates of the game, the matched one first.
    """

    score: float
    patch: _Patch
    pose: Pose
    game: tuple[Template, ...]

    @property
    def centre(self) -> tuple[float, float]:
        """Centre of the court in the image."""
        pose = self.patch.pose_in_image(self.pose)
        return pose.x, pose.y


def find_courts(
    raster: Raster,
    prior: SceneScalePrior | None = None,
    runtime: Runtime | None = None,
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
    proposals: list[Proposal] = []
    for factor in factors:
        proposals += network.propose(raster, factor)
    return courts_among(raster, proposals, n_sizes=len(factors))


def courts_among(raster: Raster, proposals: Sequence[Proposal], *, n_sizes: int = 1) -> list[Court]:
    """Measure the courts among proposals; see ``find_courts``.

    Args:
        raster: the image.
        proposals: in no order.
        n_sizes: number of reduction factors that were searched.
    """
    n_proposals = _MAX_PROPOSALS
    if n_sizes == 1:
        n_proposals = _MAX_PROPOSALS_OF_ONE_SIZE
    matches: list[_Match] = []
    for proposal in islice(_distinct(proposals), n_proposals):
        matches += _matches(raster, proposal)
    matches.sort(key=lambda candidate: -candidate.score)

    courts: list[Court] = []
    n_rejected = 0
    for candidate in matches:
        if n_rejected == _MAX_REJECTED or len(courts) == _MAX_COURTS:
            break
        if _lies_in_any(candidate.centre, courts):
            continue
        court = _measured_court(raster, candidate)
        if court is None:
            n_rejected += 1
            continue
        n_rejected = 0
        # The fit may have moved to a court that was found before.
        if not _lies_in_any(court.centre, courts):
            courts.append(court)
    return sorted(courts, key=lambda court: -court.score)


def _distinct(proposals: Sequence[Proposal]) -> Iterator[Proposal]:
    """Yield proposals by falling score, without those near a better one of like size.

    This is lazy because large images have thousands of proposals and the first few suffice.
    """
    kept: list[Proposal] = []
    best_first = sorted(proposals, key=lambda proposal: -proposal.share)
    for proposal in best_first:
        if not any(_is_same(proposal, better) for better in kept):
            kept.append(proposal)
            yield proposal


def _is_same(proposal: Proposal, better: Proposal) -> bool:
    """Test whether a proposal is near a better one of like size."""
    if better.factor != proposal.factor:
        return False
    pose = proposal.pose
    dx = pose.x - better.pose.x
    dy = pose.y - better.pose.y
    return math.hypot(dx, dy) < TENNIS.length_m * _SAME_COURT * pose.px_per_m


def _matches(raster: Raster, proposal: Proposal) -> list[_Match]:
    """Match the templates of all games near a proposal.

    Returns:
        The matches, the best first; empty if there are too few lines.
    """
    # The proposed game is the first: its size is that of the pose.
    games = [(TENNIS,), BASKETBALL]
    if proposal.which:
        games.reverse()
    # The first template represents its game in the search.
    templates = [game[0] for game in games]
    length_px = LENGTHS_M[proposal.which] * proposal.pose.px_per_m
    # The coarsest resolution that still shows the lines.
    octaves = math.floor(math.log2(length_px / _MATCHED_PX))
    factor = 2 ** max(0, octaves)
    proposed_template = templates[0]
    patch = _read(raster, proposal.pose, proposed_template, factor)
    start = patch.pose_in_patch(proposal.pose)
    radius_px = _AROUND * proposed_template.length_m * start.px_per_m
    angles = []
    for direction in axes(patch.grey, start.x, start.y, radius_px):
        # Either side of the rectangle may be the long one.
        angles += [direction, direction + _QUARTER]
    matched = match(
        patch.grey,
        templates,
        start=start,
        log_sizes=_WIDE_LOG_SIZES,
        places=_WIDE_PLACES,
        angles=angles,
    )
    matches = [
        _Match(score, patch, pose=pose, game=game)
        for (score, pose), game in zip(matched, games, strict=True)
        if score >= _MIN_MATCH_SCORE
    ]
    return sorted(matches, key=lambda candidate: -candidate.score)


def _measured_court(raster: Raster, candidate: _Match) -> Court | None:
    """Measure the court near a match with the game's best template.

    Returns:
        The court; None if the lines do not support it.
    """
    patch = candidate.patch
    first_template = candidate.game[0]
    start = pose_matrix(candidate.pose)
    first_fit = fit(patch.grey, first_template, start, SIMILARITY)
    length_px = first_template.length_m * first_fit.px_per_m * patch.factor
    if length_px < _MIN_PX:
        return None

    # Match again at the fitted pose: a true court scores high there.
    fitted_pose = _pose_of(first_fit.matrix)
    matched = match(
        patch.grey,
        candidate.game,
        start=fitted_pose,
        log_sizes=_CLOSE_LOG_SIZES,
        places=_CLOSE_PLACES,
        angles=[fitted_pose.angle],
    )
    score, pose = max(matched, key=itemgetter(0))
    if score < _MIN_SCORE:
        return None

    # The rules whose lines are covered best.
    fits = [_fine_fit(raster, template, patch, pose) for template in candidate.game]
    best = max(fits, key=lambda fine_fit: fine_fit.fit.coverage)
    template = best.template
    outline = project(best.fit.matrix, template.outline)
    corners = best.patch.points_in_image(outline)
    image_size = (raster.width_px, raster.height_px)
    is_outside = (corners < 0) | (corners > image_size)
    if is_outside.any():
        return None
    if not _is_supported(best):
        return None
    px_per_m = best.fit.px_per_m * best.patch.factor
    return Court(
        kind=template.kind,
        corners=corners,
        length_m=template.length_m,
        width_m=template.width_m,
        gsd_m_per_px=float(1.0 / px_per_m),
        log_sd=best.fit.log_sd,
        score=score,
        coverage=best.fit.coverage,
    )


class _FineFit(NamedTuple):
    """Fit of a template at the finest useful resolution.

    Attributes:
        fit: the fit, in pixels of the patch.
        template: the template.
        patch: patch of that resolution.
    """

    fit: Fit
    template: Template
    patch: _Patch


def _is_supported(fine_fit: _FineFit) -> bool:
    """Test whether a fit covers the lines and the arcs of a court, and has its shape."""
    court_fit, template, patch = fine_fit
    if court_fit.coverage < _MIN_COVERAGE:
        return False
    if not math.isfinite(court_fit.log_sd):
        return False
    arc_coverage = court_fit.line_coverage[len(template.lines) :]
    if len(arc_coverage) and arc_coverage.mean() < _MIN_ARC_COVERAGE:
        return False
    if surplus_share(patch.grey, template, court_fit) > _MAX_SURPLUS:
        return False
    # With two more degrees of freedom, a true court keeps its proportions and right angles.
    affine_fit = fit(patch.grey, template, court_fit.matrix, AFFINE)
    return affine_fit.distortion <= _MAX_DISTORTION


def _fine_fit(raster: Raster, template: Template, patch: _Patch, pose: Pose) -> _FineFit:
    """Fit at the resolution of the match, then at finer ones while the image has more pixels."""
    court_fit = fit(patch.grey, template, pose_matrix(pose), SIMILARITY)
    while patch.factor > 1:
        length_px = template.length_m * court_fit.px_per_m
        if length_px >= _FITTED_PX:
            break
        pose_in_image = patch.pose_in_image(_pose_of(court_fit.matrix))
        patch = _read(raster, pose_in_image, template, patch.factor // 2)
        start = pose_matrix(patch.pose_in_patch(pose_in_image))
        court_fit = fit(patch.grey, template, start, SIMILARITY)
    return _FineFit(court_fit, template=template, patch=patch)


def _read(raster: Raster, pose: Pose, template: Template, factor: int) -> _Patch:
    """Read the patch that covers the whole search range of a court, clipped to the image."""
    half_diagonal_m = math.hypot(template.length_m, template.width_m) / 2
    half_diagonal_px = half_diagonal_m * pose.px_per_m / factor
    farthest = _WIDE_PLACES[-1]
    half = half_diagonal_px * _MARGIN + farthest
    x = (pose.x + 0.5) / factor
    y = (pose.y + 0.5) / factor
    width = raster.width_px // factor
    height = raster.height_px // factor
    left, columns = _clipped_span(x, half, width)
    top, rows = _clipped_span(y, half, height)
    window = Window(left, top, width_px=columns, height_px=rows)
    pixels = read_reduced_window(raster, window, factor)
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    grey_levels = np.asarray(grey, np.float32)
    return _Patch(grey_levels, factor, left=left, top=top)


def _clipped_span(centre: float, half: float, side_px: int) -> tuple[int, int]:
    """Clip an interval around a centre to a side of the image; return its start and length."""
    start = int(np.clip(centre - half, 0, side_px - 1))
    end = int(np.clip(centre + half, start + 1, side_px))
    return start, end - start


def _pose_of(matrix: NDArray[np.float64]) -> Pose:
    """Convert a similarity matrix to a pose."""
    cos, _, x = matrix[0]
    sin, _, y = matrix[1]
    angle = math.atan2(sin, cos)
    px_per_m = math.hypot(cos, sin)
    return Pose(float(x), float(y), angle, px_per_m)


def _lies_in_any(point: tuple[float, float], courts: Sequence[Court]) -> bool:
    """Test whether a point lies in the central part of a court."""
    for court in courts:
        middle = court.corners.mean(axis=0)
        central_part = middle + _CENTRAL * (court.corners - middle)
        outline = np.asarray(central_part, np.float32)
        if cv2.pointPolygonTest(outline, point, measureDist=False) >= 0:
            return True
    return False


def axes(grey: GreyImage, x: float, y: float, radius: float) -> list[float]:
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
    height, width = grey.shape
    rows, columns = np.ogrid[:height, :width]
    squared_distance = (columns - x) ** 2 + (rows - y) ** 2
    near = squared_distance < radius**2
    smoothed = cv2.GaussianBlur(grey, (0, 0), _SMOOTH_PX)
    gradient_x = cv2.Scharr(smoothed, cv2.CV_32F, 1, 0)
    gradient_y = cv2.Scharr(smoothed, cv2.CV_32F, 0, 1)
    across = np.asarray(gradient_x, np.float32)[near]
    down = np.asarray(gradient_y, np.float32)[near]
    histogram = _direction_histogram(across, down)

    # Peaks of the histogram, each with the maximum of a parabola through it and its neighbours.
    directions: list[float] = []
    rest = histogram.copy()
    bins_around = np.arange(-_APART_BINS, _APART_BINS + 1)
    while len(directions) < 2:
        peak = int(rest.argmax())
        min_height = _SECOND_SHARE * histogram.max()
        if directions and rest[peak] < min_height:
            break
        before = histogram[peak - 1]
        after = histogram[(peak + 1) % _BINS]
        bend = before - 2 * histogram[peak] + after
        shift = 0.0
        if bend < 0:
            shift = (before - after) / (2 * bend)
        position = peak + 0.5 + shift
        directions.append(position * _QUARTER / _BINS)
        around_peak = (peak + bins_around) % _BINS
        rest[around_peak] = 0.0
    return directions


def _direction_histogram(across: Gradients, down: Gradients) -> NDArray[np.float64]:
    """Compute the smoothed histogram of the directions of clear gradients, modulo a quarter turn.

    Args:
        across: ``[n]`` gradients along +x.
        down: ``[n]`` gradients along +y.

    Returns:
        ``[bins]`` weights.
    """
    steepness = np.hypot(across, down)
    is_clear = steepness > np.quantile(steepness, _TEXTURE_SHARE)
    weights = np.minimum(steepness[is_clear], _MAX_STEEPNESS)
    angles = np.arctan2(down[is_clear], across[is_clear])
    directions = angles % _QUARTER
    positions = directions / _QUARTER * _BINS
    bins = positions.astype(np.intp) % _BINS
    counts = np.bincount(bins, weights, _BINS)
    before = np.roll(counts, 1)
    after = np.roll(counts, -1)
    return (before + 2 * counts + after) / 4
