"""Courts of an image: proposed on coarse views, matched and fitted by their lines on finer ones, and judged."""

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
from vehanchor.models.session import DEFAULT_PROVIDERS

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import onnxruntime
    from numpy.typing import NDArray

    from vehanchor.courts.fit import Fit
    from vehanchor.courts.proposals import Proposal
    from vehanchor.courts.template import Template
    from vehanchor.detection.card import DetectorCard
    from vehanchor.detection.detections import Detections
    from vehanchor.detection.scene_scale import SceneScalePrior
    from vehanchor.imagery.raster import Raster

_FAR = Reach(0.0, 1.0, 0.4, 0.04, 27, 3)  # proposals lie on a court's end as often as on its middle
_NEAR = Reach(math.radians(4), math.radians(2), 0.045, 0.015, 3, 1)
_THERE = Reach(0.0, 1.0, 0.01, 0.01, 1, 1)
_MOST_COURTS = 4
_MOST_LOOKED_AT, _MOST_OF_ONE_SIZE = 20, 6  # proposals, the surest; fewer where the ground says how large courts are
_MOST_IN_VAIN = 4  # of what has lines like a court, one after the other
_PERSPECTIVE_PX = 150.0  # least length of a court for a homography
_FITTED_PX = 220.0  # a court is fitted at the coarsest resolution at which it is at least so long, if there is one
_AROUND = 0.6  # of a court's length: where the directions of its lines are looked for
_LEAST_PX = 60.0  # length of a court in the image: of a shorter one lines are a pixel or two apart, and much looks so
_MATCHED_PX = 72.0  # least length of a court whose lines are looked for, where there are so many pixels
_MARGIN = 1.5  # of the patch that is read, over the court's half diagonal

_WORTH_A_FIT = 0.3
_LEAST_NEAR = 0.45  # of the score before the fit: every court had 0.57 or more (RESULTS.md)
_LEAST_SCORE = 0.55  # 0.50 is the most that came of 232 training images without a court (RESULTS.md)
_ROUGH_COVERAGE = 0.5
_LEAST_COVERAGE = 0.64  # roofs with grids came to 0.63
_LEAST_COVERAGE_WITH_ARCS, _SEEN_ARCS = 0.68, 0.5  # straight lines alone make grids on yards and car parks, too
_SEEN_LINE = 0.4
_UNSEEN_LINES = 2
_MOST_DISTORTION = 0.06


class _Patch(NamedTuple):
    """Grey levels around a court: reduced by ``factor``, its first pixel at (left, top) of the reduced image."""

    grey: NDArray[np.float32]
    factor: int
    left: int
    top: int

    def inside(self, pose: Pose) -> Pose:
        """A pose of the image in the patch's pixels."""
        x, y = ((value + 0.5) / self.factor - 0.5 for value in (pose.x, pose.y))
        return Pose(x - self.left, y - self.top, pose.angle, pose.px_per_m / self.factor)

    def in_image(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points of the patch, counted from its first pixel's centre, in the image, counted from that one's corner."""
        return np.asarray((points + (self.left, self.top) + 0.5) * self.factor)

    def outside(self, pose: Pose) -> Pose:
        """A pose of the patch in the image's pixels."""
        x, y = ((value + 0.5) * self.factor - 0.5 for value in (pose.x + self.left, pose.y + self.top))
        return Pose(x, y, pose.angle, pose.px_per_m * self.factor)


class _Laid(NamedTuple):
    """A game's lines laid over those of a patch: how well, and where; its templates, the one that was laid first."""

    score: float
    patch: _Patch
    pose: Pose
    game: tuple[Template, ...]


class Proposed(NamedTuple):
    """Where courts may be.

    Attributes:
        proposals: in no order.
        n_sizes: at how many reductions of the image they were looked for.
    """

    proposals: Sequence[Proposal]
    n_sizes: int


def propose_courts(
    raster: Raster,
    detections: Detections,
    card: DetectorCard,
    prior: SceneScalePrior | None = None,
    *,
    providers: tuple[str, ...] | None = None,
    run_options: onnxruntime.RunOptions | None = None,
) -> Proposed:
    """Say where courts may be, by the network and by a detector that knows courts; as ``find_courts``."""
    proposals = boxes_of_courts(detections, card)
    # one thread: it is small, and a worker of one thread shall not wake all cores for it
    network = load_court_network(threads=1, providers=providers or DEFAULT_PROVIDERS)
    factors = [] if network is None else coarse_factors(raster, prior)
    if network is not None:
        for factor in factors:
            proposals += network.propose(raster, factor, run_options=run_options)
    return Proposed(proposals, len(factors))


def find_courts(
    raster: Raster,
    detections: Detections,
    card: DetectorCard,
    prior: SceneScalePrior | None = None,
    *,
    proposed: Proposed | None = None,
    providers: tuple[str, ...] | None = None,
    run_options: onnxruntime.RunOptions | None = None,
) -> tuple[Court, ...]:
    """Find and measure the courts that lie whole in an image.

    Args:
        raster: the image.
        detections: result of the search.
        card: of the detector.
        prior: the scene-scale prior; None without one.
        proposed: where they may be; None has them looked for (``propose_courts``).
        providers: where the network runs that looks for them; None for the CPU.
        run_options: ONNX Runtime's, for a caller that may have to end a run.

    Returns:
        At most four, the surest first. A court half hidden, or cut by the image's edge, is none.
    """
    proposals, n_sizes = proposed or propose_courts(
        raster, detections, card, prior, providers=providers, run_options=run_options
    )
    surest = islice(_apart(proposals), _MOST_OF_ONE_SIZE if n_sizes == 1 else _MOST_LOOKED_AT)
    laid = [each for proposal in surest for each in _laid(raster, proposal)]
    found: list[Court] = []
    in_vain = 0
    for one in sorted(laid, key=lambda each: -each.score):
        if in_vain == _MOST_IN_VAIN or len(found) == _MOST_COURTS:
            break
        if any(_lies_in(one.patch.outside(one.pose), court) for court in found):
            continue
        court = _measured(raster, one)
        in_vain = 0 if court else in_vain + 1
        if court is not None and not any(_lies_in(_pose_of(court), other) for other in found):
            found.append(court)
    return tuple(sorted(found, key=lambda court: -court.score))


def _apart(proposals: Sequence[Proposal]) -> Iterator[Proposal]:
    """The surest first, without what lies within a quarter of a court's length of a surer one of like size.

    One after the other: of the thousands in a large image the first few settle it.
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
    """Match, fit and judge what may be a court; None where its lines do not bear it out.

    Args:
        raster: the image.
        proposal: where it may be. That it names the wrong game does no harm.
    """
    courts = (_measured(raster, each) for each in _laid(raster, proposal))
    return next((court for court in courts if court is not None), None)


def rough_court(raster: Raster, proposal: Proposal) -> Court | None:
    """Lay a template in perspective over what may be a court, seen from aside; None where too few lines bear it out.

    What comes is a guess at its shape, not a court: judge it where it is seen from straight above.
    """
    for _, patch, start, game in _laid(raster, proposal):
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


def _laid(raster: Raster, proposal: Proposal) -> list[_Laid]:
    """Where templates lie best near a proposal, the game that fits best first; none where there are too few lines."""
    games = ((TENNIS,), BASKETBALL)[:: -1 if proposal.which else 1]
    firsts = [game[0] for game in games]  # each stands for its game while it is searched for
    patch = _read(raster, proposal.pose, firsts[0], _matched_factor(proposal))
    start = patch.inside(proposal.pose)
    turned = axes(patch.grey, start.x, start.y, _AROUND * firsts[0].length_m * start.px_per_m)
    angles = [axis + quarter for axis in turned for quarter in (0.0, math.pi / 2)]
    matched = match(patch.grey, firsts, start, _FAR, angles)
    laid = [_Laid(score, patch, pose, game) for (score, pose), game in zip(matched, games, strict=True)]
    return sorted((each for each in laid if each.score >= _WORTH_A_FIT), key=lambda each: -each.score)


def _matched_factor(proposal: Proposal) -> int:
    """The coarsest reduction at which a court so large still shows its lines."""
    length_px = LENGTHS_M[proposal.which] * proposal.pose.px_per_m
    return int(2 ** max(0, math.floor(math.log2(length_px / _MATCHED_PX))))


def _measured(raster: Raster, laid: _Laid) -> Court | None:
    """The court of the template that fits best near where its game was laid."""
    _, patch, pose, templates = laid
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
    return _judged(template, seen, patch, corners, score) if _borne_out(template, seen) else None


def _judged(template: Template, seen: Fit, patch: _Patch, corners: NDArray[np.float64], score: float) -> Court | None:
    """The court whose lines are seen, if it keeps the rules' shape where it may shear or is seen in perspective."""
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
    """Fit at the resolution of the match and, where there are more pixels, at finer ones."""
    seen = fit(patch.grey, template, pose_matrix(pose), SIMILARITY)
    while patch.factor > 1 and template.length_m * seen.px_per_m < _FITTED_PX:
        finer = _read(raster, patch.outside(_pose(seen.matrix)), template, patch.factor // 2)
        seen = fit(finer.grey, template, pose_matrix(finer.inside(patch.outside(_pose(seen.matrix)))), SIMILARITY)
        patch = finer
    return seen, patch


def _borne_out(template: Template, seen: Fit) -> bool:
    lines, arcs = np.split(seen.line_coverage, [len(template.lines)])
    unseen = int((lines < _SEEN_LINE).sum())
    return (
        seen.coverage >= (_LEAST_COVERAGE_WITH_ARCS if len(arcs) else _LEAST_COVERAGE)
        and (not len(arcs) or float(arcs.mean()) >= _SEEN_ARCS)
        and unseen <= _UNSEEN_LINES
        and math.isfinite(seen.log_sd)
    )


def _read(raster: Raster, pose: Pose, template: Template, factor: int) -> _Patch:
    """The patch that holds a court wherever it is searched, as far as the image reaches."""
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
    """The pose of a similarity."""
    (a, _, x), (c, _, y) = matrix[:2]
    return Pose(float(x), float(y), math.atan2(c, a), math.hypot(a, c))


def _pose_of(court: Court) -> Pose:
    (x, y), along = court.corners.mean(axis=0), court.corners[1] - court.corners[0]
    return Pose(float(x), float(y), math.atan2(along[1], along[0]), 1.0 / court.gsd_m_per_px)


def _lies_in(pose: Pose, court: Court) -> bool:
    """Whether the centre of one lies in the middle of another."""
    corners = court.corners - court.corners.mean(axis=0)
    outline = np.asarray(court.corners.mean(axis=0) + 0.6 * corners, np.float32)
    return cv2.pointPolygonTest(outline, (pose.x, pose.y), measureDist=False) >= 0
