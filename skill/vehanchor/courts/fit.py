"""Subpixel fit of a court: every piece of its lines pulls the template to its observed position."""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.courts.templates import Pose, Template

# Length of line over which a profile is averaged; a player hides one piece, not all.
_PIECE_M = 2.4
# A profile across a line: its sampling step, and the distance of the flanks from the line.
_STEP_PX = 0.25
_FLANK_PX = 2.0
# Largest number of samples along a piece.
_MAX_SAMPLES = 64
# Largest offset of a line in each round of the fit.
_REACHES_PX = (4.0, 3.0, 2.5, 2.0, 2.0, 2.0)
# Contrast of a line in the averaged profile: grey levels, and multiples of the noise.
_MIN_CONTRAST = 1.2
_CONTRAST_PER_NOISE = 0.7
# Largest offset of a piece that counts as covered by a line.
_NEAR_PX = 0.8
# Offset from which a piece is an outlier in the last rounds of the solution.
_TUKEY_PX = 1.5
# Least residual, pixels: fits are not better than the pixels, however few lines there are.
_MIN_RESIDUAL_PX = 0.1
# Largest condition number at which the size's error is finite.
_MAX_CONDITION = 1e12
# Step of the numerical derivatives.
_EPSILON = 1e-4

# Small motions of a court in its own metres.
_MOTIONS = np.array(
    [
        [[0, 0, 1], [0, 0, 0], [0, 0, 0]],  # along
        [[0, 0, 0], [0, 0, 1], [0, 0, 0]],  # across
        [[1, 0, 0], [0, 1, 0], [0, 0, 0]],  # size
        [[0, -1, 0], [1, 0, 0], [0, 0, 0]],  # rotation
        [[1, 0, 0], [0, -1, 0], [0, 0, 0]],  # stretch
        [[0, 1, 0], [1, 0, 0], [0, 0, 0]],  # shear
    ],
    dtype=np.float64,
)
_SIZE = 2
_NUDGES = np.eye(3) + _EPSILON * _MOTIONS
# Degrees of freedom: the first motions.
SIMILARITY = 4
AFFINE = 6


class Fit(NamedTuple):
    """Fitted template and its quality.

    Attributes:
        matrix: ``[3, 3]`` from metres on the court to pixels.
        coverage: 0..1, share of the lines' length found where it should be.
        line_coverage: ``[lines]`` coverage of each line.
        log_sd: standard deviation of the log size, from the residuals.
    """

    matrix: NDArray[np.float64]
    coverage: float
    line_coverage: NDArray[np.float64]
    log_sd: float

    @property
    def px_per_m(self) -> float:
        """Pixels per metre: square root of the scale of areas."""
        return math.sqrt(abs(float(np.linalg.det(self.matrix[:2, :2]))))

    @property
    def distortion(self) -> float:
        """Deviation from the shape in the rules: the larger of log stretch and shear."""
        local = self.matrix[:2, :2]
        along = np.hypot(*local[:, 0])
        across = np.hypot(*local[:, 1])
        log_stretch = abs(math.log(along / across))
        shear = abs(local[:, 0] @ local[:, 1]) / (along * across)
        return float(max(log_stretch, shear))


def pose_matrix(pose: Pose) -> NDArray[np.float64]:
    """Build the matrix ``[3, 3]`` from metres on a court to pixels."""
    cos = math.cos(pose.angle) * pose.px_per_m
    sin = math.sin(pose.angle) * pose.px_per_m
    return np.array([[cos, -sin, pose.x], [sin, cos, pose.y], [0.0, 0.0, 1.0]])


def project(matrix: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Project points ``[n, 2]`` through a matrix ``[3, 3]``, or through each of ``[k, 3, 3]``."""
    turned = points @ matrix[..., :2, :2].swapaxes(-1, -2)
    return np.asarray(turned + matrix[..., None, :2, 2])


class _Pieces(NamedTuple):
    """Pieces of a template's lines.

    Attributes:
        starts: ``[n, 2]`` metres.
        ends: ``[n, 2]`` metres.
        middles: ``[n, 2]`` metres.
        lengths: ``[n]`` metres.
        line: ``[n]`` index of the line of each piece.
    """

    starts: NDArray[np.float64]
    ends: NDArray[np.float64]
    middles: NDArray[np.float64]
    lengths: NDArray[np.float64]
    line: NDArray[np.intp]


@cache
def _cut(template: Template) -> _Pieces:
    """Cut the lines of a template into pieces."""
    starts = []
    ends = []
    lines = []
    for index, line in enumerate(np.concatenate([template.lines, template.arcs])):
        length_m = np.hypot(line[2] - line[0], line[3] - line[1])
        count = max(1, round(length_m / _PIECE_M))
        shares = np.linspace(0, 1, count + 1)[:, None]
        points = (1 - shares) * line[:2] + shares * line[2:]
        starts.append(points[:-1])
        ends.append(points[1:])
        lines += [index] * count
    first = np.concatenate(starts)
    last = np.concatenate(ends)
    return _Pieces(
        starts=first,
        ends=last,
        middles=(first + last) / 2,
        lengths=np.hypot(*(last - first).T),
        line=np.array(lines),
    )


def fit(
    grey: NDArray[np.float32], template: Template, matrix: NDArray[np.float64], freedom: int
) -> Fit:
    """Fit a template to the lines of an image.

    Args:
        grey: ``[h, w]`` grey levels.
        template: template of the court.
        matrix: ``[3, 3]`` from metres to pixels, correct to a few pixels.
        freedom: degrees of freedom: 4 similarity, 6 affine.
    """
    pieces = _cut(template)
    jacobian = np.zeros((0, freedom))
    # Gauss-Newton: each round measures the offsets of the lines and moves the template to them.
    for reach in _REACHES_PX:
        offsets, strengths = _line_offsets(grey, pieces, matrix, reach)
        jacobian = _jacobian(pieces, matrix, freedom)
        motion = _solve(jacobian, offsets, strengths * pieces.lengths)
        if motion is None:
            break
        step = np.tensordot(motion, _MOTIONS[: len(motion)], axes=1)
        matrix = matrix @ (np.eye(3) + step)

    offsets, strengths = _line_offsets(grey, pieces, matrix, _REACHES_PX[-1])
    near = (strengths > 0) & (np.abs(offsets) <= _NEAR_PX)
    lengths = np.bincount(pieces.line, pieces.lengths)
    covered = np.bincount(pieces.line, pieces.lengths * near)
    return Fit(
        matrix,
        coverage=float(covered.sum() / lengths.sum()),
        line_coverage=covered / lengths,
        log_sd=_size_error(jacobian[near], offsets[near]),
    )


def _size_error(jacobian: NDArray[np.float64], residuals: NDArray[np.float64]) -> float:
    """Compute the standard deviation of a fit's log size from its residuals.

    Args:
        jacobian: ``[pieces, freedom]`` of the covered pieces.
        residuals: ``[pieces]`` their offsets, pixels.

    Returns:
        The error; inf if the pieces do not determine the size.
    """
    n_pieces, freedom = jacobian.shape
    if n_pieces <= freedom:
        return math.inf
    # Covariance of a least-squares solution: residual variance times the inverse normal matrix.
    normal = jacobian.T @ jacobian
    if not np.linalg.cond(normal) < _MAX_CONDITION:
        return math.inf
    residual = float(np.sqrt(np.mean(residuals**2)))
    covariance = max(residual, _MIN_RESIDUAL_PX) ** 2 * np.linalg.inv(normal)
    return math.sqrt(covariance[_SIZE, _SIZE])


def _line_offsets(
    grey: NDArray[np.float32], pieces: _Pieces, matrix: NDArray[np.float64], reach_px: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Measure the offset of the visible line from each piece.

    Args:
        grey: ``[h, w]`` grey levels.
        pieces: pieces of the template.
        matrix: ``[3, 3]`` from metres to pixels.
        reach_px: largest offset.

    Returns:
        Offsets ``[n]``, pixels along the normals, and strengths of the lines ``[n]``, 0..1.
    """
    starts = project(matrix, pieces.starts)
    ends = project(matrix, pieces.ends)
    across = np.arange(-reach_px - _FLANK_PX, reach_px + _FLANK_PX + _STEP_PX / 2, _STEP_PX)
    profiles = _profiles(grey, starts, ends, across)

    # A line is brighter than the profile on both sides of it.
    flank = round(_FLANK_PX / _STEP_PX)
    inner = profiles[:, flank:-flank]
    ridge = inner - np.maximum(profiles[:, : -2 * flank], profiles[:, 2 * flank :])
    peak, height, shift = _highest(ridge)
    offsets = across[flank:-flank][peak] + shift * _STEP_PX

    # A peak at the end of the profile, or a piece outside the image, shows no line.
    noise = np.median(np.abs(np.diff(inner[:, ::4], axis=1)))
    least = max(_MIN_CONTRAST, _CONTRAST_PER_NOISE * float(noise))
    at_end = (peak == 0) | (peak == ridge.shape[1] - 1)
    inside = ((starts >= 0) & (starts <= np.array(grey.shape[::-1]) - 1)).all(axis=1)
    strengths = np.where(at_end | ~inside, 0.0, np.clip((height - least) / least, 0, 1))
    return offsets, strengths


def _highest(
    ridge: NDArray[np.float32],
) -> tuple[NDArray[np.intp], NDArray[np.float32], NDArray[np.float32]]:
    """Find the highest value of each row ``[n, m]``.

    Returns:
        Its columns ``[n]``, its values ``[n]``, and the shifts ``[n]``, -0.5 to 0.5, from the
        columns to the peaks of parabolas through the values and their neighbours.
    """
    rows = np.arange(len(ridge))
    peak = ridge.argmax(axis=1)
    height = ridge[rows, peak]
    left = ridge[rows, np.maximum(peak - 1, 0)]
    right = ridge[rows, np.minimum(peak + 1, ridge.shape[1] - 1)]
    bend = np.minimum(left - 2 * height + right, -1e-6)
    shift = np.clip((left - right) / (2 * bend), -0.5, 0.5)
    return peak, height, shift


def _profiles(
    grey: NDArray[np.float32],
    starts: NDArray[np.float64],
    ends: NDArray[np.float64],
    across: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Average the grey levels along each piece, at several distances across it.

    Args:
        grey: ``[h, w]`` grey levels.
        starts: ``[n, 2]`` pixels.
        ends: ``[n, 2]`` pixels.
        across: ``[m]`` distances, pixels along the normals.

    Returns:
        ``[n, m]`` grey levels.
    """
    longest_px = np.hypot(*(ends - starts).T).max()
    count = int(np.clip(longest_px, 2, _MAX_SAMPLES))
    shares = (np.arange(count) + 0.5)[:, None, None] / count
    points = (1 - shares) * starts + shares * ends  # [count, n, 2]
    normals = _normals(starts, ends)
    # Two planes of coordinates take a third of the time of pairs.
    places = np.empty((2, count, len(starts), len(across)), np.float32)
    for axis, plane in enumerate(places):
        np.add(points[:, :, None, axis], across * normals[:, None, axis], out=plane)
    x, y = places.reshape(2, count, -1)
    sampled = cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(sampled.reshape(places.shape[1:]).mean(axis=0))


def _normals(starts: NDArray[np.float64], ends: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the unit normals ``[n, 2]`` of pieces."""
    along = ends - starts
    across = np.stack([-along[:, 1], along[:, 0]], axis=1)
    return np.asarray(across / np.hypot(*along.T)[:, None])


def _jacobian(pieces: _Pieces, matrix: NDArray[np.float64], freedom: int) -> NDArray[np.float64]:
    """Compute the motion of each piece along its normal, for a unit of each motion.

    Returns:
        ``[pieces, freedom]`` pixels.
    """
    normals = _normals(project(matrix, pieces.starts), project(matrix, pieces.ends))
    middles = project(matrix, pieces.middles)
    nudged = project(matrix @ _NUDGES[:freedom], pieces.middles)
    along_normals = ((nudged - middles) * normals).sum(axis=2)
    return np.ascontiguousarray(along_normals.T / _EPSILON)


def _solve(
    jacobian: NDArray[np.float64], offsets: NDArray[np.float64], weights: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Solve for the motion that moves the pieces onto the lines, without outliers.

    Iteratively reweighted least squares with Tukey's biweight.

    Args:
        jacobian: ``[pieces, freedom]`` motions of the pieces.
        offsets: ``[pieces]`` offsets of the lines.
        weights: ``[pieces]``; 0 without a line.

    Returns:
        ``[freedom]``; None if there are too few lines.
    """
    n_motions = jacobian.shape[1]
    if (weights > 0).sum() <= n_motions:
        return None
    motion: NDArray[np.float64] = np.zeros(n_motions)
    for turn in range(4):
        residuals = offsets - jacobian @ motion
        # The first turns are more tolerant, because the motion is unknown.
        width = _TUKEY_PX * (3 - min(turn, 2))
        biweight = (1 - (residuals / width) ** 2) ** 2
        trust = weights * np.where(np.abs(residuals) < width, biweight, 0.0)
        weighted = (jacobian * trust[:, None]).T
        normal = weighted @ jacobian
        # A little damping, in case no piece shows one of the motions.
        normal += 1e-9 * np.trace(normal) / n_motions * np.eye(n_motions)
        try:
            motion = np.asarray(np.linalg.solve(normal, weighted @ offsets), np.float64)
        except np.linalg.LinAlgError:
            return None
    return motion
