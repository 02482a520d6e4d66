"""Courts of an image: proposed at low resolution, then matched, fitted and verified by their lines."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from vehanchor.courts.axes import axes
from vehanchor.courts.court import Court
from vehanchor.courts.fit import AFFINE, HOMOGRAPHY, SIMILARITY, fit, pose_matrix, project
from vehanchor.courts.match import Pose, Reach, match
from vehanchor.courts.proposals import LENGTHS_M, boxes_of_courts, coarse_factors, load_court_network
from vehanchor.courts.template import BASKETBALL, TENNIS
from vehanchor.imagery.raster import Window
from vehanchor.imagery.tiles import read_reduced_window
from vehanchor.models.runtime import Runtime

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from vehanchor.courts.fit import Fit
    from vehanchor.courts.proposals import Proposal
    from vehanchor.courts.template import Template
    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.detections import Detections
    from vehanchor.detection.scene_scale import SceneScalePrior
    from vehanchor.imagery.raster import Raster

_FAR = Reach(0.0, 1.0, 0.4, 0.04, 27, 3)  # proposals lie at a court's end as often as at its centre
_NEAR = Reach(math.radians(4), math.radians(2), 0.045, 0.015, 3, 1)
_THERE = Reach(0.0, 1.0, 0.01, 0.01, 1, 1)
_MOST_COURTS = 4
_MOST_PROPOSALS, _MOST_OF_ONE_SIZE = 20, 6  # best proposals to try; fewer if the scale is known
_MOST_REJECTED = 4  # rejected candidates in a row before the search ends
_PERSPECTIVE_PX = 150.0  # least length of a court for a homography
_FITTED_PX = 220.0  # a court is fitted at the coarsest resolution that makes it this long, if there is one
_AROUND = 0.6  # of a court's length: radius for the directions of its lines
_LEAST_PX = 60.0  # least length of a court; in shorter ones the lines are a pixel or two apart, as in many textures
_MATCHED_PX = 72.0  # least length of a court for matching, if the image has that resolution
_MARGIN = 1.5  # half side of the patch, in half diagonals of the court

_WORTH_A_FIT = 0.3
_LEAST_NEAR = 0.45  # of the score before the fit; every court had at least 0.57
_LEAST_SCORE = 0.55  # the maximum over 232 training images without a court is 0.50
_ROUGH_COVERAGE = 0.5
_LEAST_COVERAGE = 0.64  # roofs with grids reached 0.63
_LEAST_COVERAGE_WITH_ARCS, _SEEN_ARCS = 0.68, 0.5  # straight lines also form grids in yards and car parks
_SEEN_LINE = 0.4
_UNSEEN_LINES = 2
_MOST_DISTORTION = 0.06


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
        x, y = ((value + 0.5) * self.factor - 0.5 for value in (pose.x + self.left, pose.y + self.top))
        return Pose(x, y, pose.angle, pose.px_per_m * self.factor)


class _Match(NamedTuple):
    """Match of a game's template with a patch: score, pose, and the game's templates, the matched one first."""

    score: float
    patch: _Patch
    pose: Pose
    game: tuple[Template, ...]


class Proposed(NamedTuple):
    """Proposals of courts in an image.

    Attributes:
        proposals: in no order.
        n_sizes: number of reduction factors that were searched.
    """

    proposals: Sequence[Proposal]
    n_sizes: int


def propose_courts(
    raster: Raster,
    detections: Detections,
    card: DetectorCard,
    prior: SceneScalePrior | None = None,
    *,
    runtime: Runtime | None = None,
) -> Proposed:
    """Propose courts from the network and from a detector with court classes; arguments as in ``find_courts``."""
    proposals = boxes_of_courts(detections, card)
    network = load_court_network(runtime)
    factors = [] if network is None else coarse_factors(raster, prior)
    if network is not None:
        for factor in factors:
            proposals += network.propose(raster, factor)
    return Proposed(proposals, len(factors))


def find_courts(
    raster: Raster,
    detections: Detections,
    card: DetectorCard,
    prior: SceneScalePrior | None = None,
    *,
    proposed: Proposed | None = None,
    runtime: Runtime | None = None,
) -> tuple[Court, ...]:
    """Find and measure the courts that lie completely inside an image.

    Args:
        raster: the image.
        detections: detections of the image.
        card: model card of the detector.
        prior: scene-scale prior; None without one.
        proposed: proposals of courts; None calls ``propose_courts``.
        runtime: of the network that proposes courts; None for the defaults.

    Returns:
        At most four courts, the highest score first. Half hidden courts and courts at the image's edge are left out.
    """
    proposals, n_sizes = proposed or propose_courts(raster, detections, card, prior, runtime=runtime)
    best = islice(_distinct(proposals), _MOST_OF_ONE_SIZE if n_sizes == 1 else _MOST_PROPOSALS)
    matches = [each for proposal in best for each in _matches(raster, proposal)]
    found: list[Court] = []
    rejected = 0
    for one in sorted(matches, key=lambda each: -each.score):
        if rejected == _MOST_REJECTED or len(found) == _MOST_COURTS:
            break
        if any(_lies_in(one.patch.outside(one.pose), court) for court in found):
            continue
        court = _measured(raster, one)
        rejected = 0 if court else rejected + 1
        if court is not None and not any(_lies_in(_pose_of(court), other) for other in found):
            found.append(court)
    return tuple(sorted(found, key=lambda court: -court.score))


def _distinct(proposals: Sequence[Proposal]) -> Iterator[Proposal]:
    """Yield proposals by falling score, without those within a quarter court length of a better one of like size.

    This is lazy because large images have thousands of proposals and the first few suffice.
    """
    kept: list[Proposal] = []
    for one in sorted(proposals, key=lambda each: -each.share):
        near = TENNIS.length_m / 4 * one.pose.px_per_m
        if not any(
            other.factor == one.factor and math.hypot(one.pose.x - other.pose.x, one.pose.y - other.pose.y) < near
            for other in kept
        ):
            kept.append(one)
            yield one


def measure_court(raster: Raster, proposal: Proposal) -> Court | None:
    """Match, fit and verify a proposal; None if its lines do not support a court.

    Args:
        raster: the image.
        proposal: the proposal; it may name the wrong game.
    """
    courts = (_measured(raster, each) for each in _matches(raster, proposal))
    return next((court for court in courts if court is not None), None)


def rough_court(raster: Raster, proposal: Proposal) -> Court | None:
    """Fit a template in perspective to a proposal in an oblique view; None if too few lines support it.

    The result is a rough shape. Verify it in a rectified view before using it as a court.
    """
    for _, patch, start, game in _matches(raster, proposal):
        ((score, pose),) = match(patch.grey, game[:1], start, _NEAR)
        seen = fit(patch.grey, game[0], pose_matrix(pose), HOMOGRAPHY)
        if seen.coverage < _ROUGH_COVERAGE or not math.isfinite(seen.corner_sd_px):
            continue
        corners = patch.in_image(project(seen.matrix, game[0].outline))
        gsd = float(1.0 / (seen.px_per_m * patch.factor))
        size = game[0].length_m, game[0].width_m
        spread = seen.corner_sd_px * patch.factor
        rough = Court(game[0].kind, corners, *size, gsd, seen.log_sd, score, seen.coverage, seen.distortion)
        return replace(rough, shape=corners, shape_sd_px=spread)
    return None


def _matches(raster: Raster, proposal: Proposal) -> list[_Match]:
    """Match the templates of all games near a proposal, the best first; empty if there are too few lines."""
    games = ((TENNIS,), BASKETBALL)[:: -1 if proposal.which else 1]
    firsts = [game[0] for game in games]  # the first template represents its game in the search
    patch = _read(raster, proposal.pose, firsts[0], _matched_factor(proposal))
    start = patch.inside(proposal.pose)
    turned = axes(patch.grey, start.x, start.y, _AROUND * firsts[0].length_m * start.px_per_m)
    angles = [axis + quarter for axis in turned for quarter in (0.0, math.pi / 2)]
    matched = match(patch.grey, firsts, start, _FAR, angles)
    matches = [_Match(score, patch, pose, game) for (score, pose), game in zip(matched, games, strict=True)]
    return sorted((each for each in matches if each.score >= _WORTH_A_FIT), key=lambda each: -each.score)


def _matched_factor(proposal: Proposal) -> int:
    """Compute the largest reduction at which a court of this size still shows its lines."""
    length_px = LENGTHS_M[proposal.which] * proposal.pose.px_per_m
    return int(2 ** max(0, math.floor(math.log2(length_px / _MATCHED_PX))))


def _measured(raster: Raster, found: _Match) -> Court | None:
    """Measure the court near a match with the game's best template; None if the lines do not support it."""
    _, patch, pose, templates = found
    ((near, pose),) = match(patch.grey, templates[:1], pose, _NEAR)
    if near < _LEAST_NEAR:
        return None
    first = fit(patch.grey, templates[0], pose_matrix(pose), SIMILARITY)
    if templates[0].length_m * first.px_per_m * patch.factor < _LEAST_PX:
        return None
    score, pose = max(match(patch.grey, templates, _pose(first.matrix), _THERE), key=lambda each: each[0])
    if score < _LEAST_SCORE:
        return None
    fits = [(kind, *_fitted(raster, kind, patch, pose)) for kind in templates]
    template, seen, patch = max(fits, key=lambda each: each[1].coverage)
    corners = patch.in_image(project(seen.matrix, template.outline))
    if (corners < 0).any() or (corners > (raster.width_px, raster.height_px)).any():
        return None
    return _undistorted(template, seen, patch, corners, score) if _is_supported(template, seen) else None


def _undistorted(
    template: Template, seen: Fit, patch: _Patch, corners: NDArray[np.float64], score: float
) -> Court | None:
    """Build the court if an affine or perspective fit keeps the shape in the rules; else None."""
    in_perspective = template.length_m * seen.px_per_m >= _PERSPECTIVE_PX
    sheared = fit(patch.grey, template, seen.matrix, HOMOGRAPHY if in_perspective else AFFINE)
    if not sheared.distortion <= _MOST_DISTORTION:
        return None
    gsd = float(1.0 / (seen.px_per_m * patch.factor))
    size = template.length_m, template.width_m
    found = Court(template.kind, corners, *size, gsd, seen.log_sd, score, seen.coverage, sheared.distortion)
    if not in_perspective:
        return found
    shape = patch.in_image(project(sheared.matrix, template.outline))
    return replace(found, shape=shape, shape_sd_px=sheared.corner_sd_px * patch.factor)


def _fitted(raster: Raster, template: Template, patch: _Patch, pose: Pose) -> tuple[Fit, _Patch]:
    """Fit at the resolution of the match, then at finer ones while the image has more pixels."""
    seen = fit(patch.grey, template, pose_matrix(pose), SIMILARITY)
    while patch.factor > 1 and template.length_m * seen.px_per_m < _FITTED_PX:
        finer = _read(raster, patch.outside(_pose(seen.matrix)), template, patch.factor // 2)
        seen = fit(finer.grey, template, pose_matrix(finer.inside(patch.outside(_pose(seen.matrix)))), SIMILARITY)
        patch = finer
    return seen, patch


def _is_supported(template: Template, seen: Fit) -> bool:
    """Test whether enough of the template's lines and arcs were found."""
    lines, arcs = np.split(seen.line_coverage, [len(template.lines)])
    unseen = int((lines < _SEEN_LINE).sum())
    return (
        seen.coverage >= (_LEAST_COVERAGE_WITH_ARCS if len(arcs) else _LEAST_COVERAGE)
        and (not len(arcs) or float(arcs.mean()) >= _SEEN_ARCS)
        and unseen <= _UNSEEN_LINES
        and math.isfinite(seen.log_sd)
    )


def _read(raster: Raster, pose: Pose, template: Template, factor: int) -> _Patch:
    """Read the patch that covers the whole search range of a court, clipped to the image."""
    half = math.hypot(template.length_m, template.width_m) / 2 * pose.px_per_m / factor * _MARGIN + _FAR.place
    x, y = (pose.x + 0.5) / factor, (pose.y + 0.5) / factor
    width, height = raster.width_px // factor, raster.height_px // factor
    left, top = (int(np.clip(value - half, 0, size - 1)) for value, size in ((x, width), (y, height)))
    right, bottom = (
        int(np.clip(value + half, low + 1, size)) for value, low, size in ((x, left, width), (y, top, height))
    )
    pixels = read_reduced_window(raster, Window(left, top, right - left, bottom - top), factor)
    grey = cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)
    return _Patch(np.asarray(grey, np.float32), factor, left, top)


def _pose(matrix: NDArray[np.float64]) -> Pose:
    """Convert a similarity matrix to a pose."""
    (a, _, x), (c, _, y) = matrix[:2]
    return Pose(float(x), float(y), math.atan2(c, a), math.hypot(a, c))


def _pose_of(court: Court) -> Pose:
    (x, y), along = court.corners.mean(axis=0), court.corners[1] - court.corners[0]
    return Pose(float(x), float(y), math.atan2(along[1], along[0]), 1.0 / court.gsd_m_per_px)


def _lies_in(pose: Pose, court: Court) -> bool:
    """Test whether a pose's centre lies in the central part of a court."""
    corners = court.corners - court.corners.mean(axis=0)
    outline = np.asarray(court.corners.mean(axis=0) + 0.6 * corners, np.float32)
    return cv2.pointPolygonTest(outline, (pose.x, pose.y), measureDist=False) >= 0
