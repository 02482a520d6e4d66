"""Subpixel fit of a court: every piece of its lines pulls the template to its observed position."""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.courts.templates import Pose, Template

    GreyImage: TypeAlias = NDArray[np.float32]
    """``[h, w]`` grey levels."""

    Matrix: TypeAlias = NDArray[np.float64]
    """``[3, 3]`` from metres on the court to pixels."""

    Points: TypeAlias = NDArray[np.float64]
    """``[n, 2]`` points, metres on the court or pixels."""

    Offsets: TypeAlias = NDArray[np.float64]
    """``[n]`` distances from the pieces to the visible lines, pixels along the normals."""

    Jacobian: TypeAlias = NDArray[np.float64]
    """``[pieces, freedom]`` pixels that each piece moves along its normal for each motion."""

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

    matrix: Matrix
    coverage: float
    line_coverage: NDArray[np.float64]
    log_sd: float

    @property
    def px_per_m(self) -> float:
        """Pixels per metre: square root of the scale of areas."""
        local = self.matrix[:2, :2]
        area_scale = abs(float(np.linalg.det(local)))
        return math.sqrt(area_scale)

    @property
    def distortion(self) -> float:
        """Deviation from the shape in the rules: the larger of log stretch and shear."""
        local = self.matrix[:2, :2]
        along, across = local.T
        px_along = np.hypot(*along)
        px_across = np.hypot(*across)
        log_stretch = abs(math.log(px_along / px_across))
        shear = abs(along @ across) / (px_along * px_across)
        return float(max(log_stretch, shear))


def pose_matrix(pose: Pose) -> Matrix:
    """Build the matrix ``[3, 3]`` from metres on a court to pixels."""
    cos = math.cos(pose.angle) * pose.px_per_m
    sin = math.sin(pose.angle) * pose.px_per_m
    rows = [
        (cos, -sin, pose.x),
        (sin, cos, pose.y),
        (0.0, 0.0, 1.0),
    ]
    return np.array(rows)


def project(matrix: Matrix, points: Points) -> Points:
    """Project points ``[n, 2]`` through a matrix ``[3, 3]``, or through each of ``[k, 3, 3]``."""
    linear = matrix[..., :2, :2]
    translation = matrix[..., None, :2, 2]
    turned = points @ linear.swapaxes(-1, -2)
    return np.asarray(turned + translation)


class _Pieces(NamedTuple):
    """Pieces of a template's lines.

    Attributes:
        starts: ``[n, 2]`` metres.
        ends: ``[n, 2]`` metres.
        middles: ``[n, 2]`` metres.
        lengths: ``[n]`` metres.
        line: ``[n]`` index of the line of each piece.
    """

    starts: Points
    ends: Points
    middles: Points
    lengths: NDArray[np.float64]
    line: NDArray[np.intp]


@cache
def _cut(template: Template) -> _Pieces:
    """Cut the lines of a template into pieces."""
    starts = []
    ends = []
    lines = []
    paint = np.concatenate([template.lines, template.arcs])
    for index, line in enumerate(paint):
        start = line[:2]
        end = line[2:]
        length_m = np.hypot(*(end - start))
        count = max(1, round(length_m / _PIECE_M))
        shares = np.linspace(0, 1, count + 1)[:, None]
        points = (1 - shares) * start + shares * end
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


def fit(grey: GreyImage, template: Template, matrix: Matrix, freedom: int) -> Fit:
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
        step = np.tensordot(motion, _MOTIONS[:freedom], axes=1)
        matrix = matrix @ (np.eye(3) + step)

    # A piece is covered if the fitted template lies on a visible line there.
    final_reach = _REACHES_PX[-1]
    offsets, strengths = _line_offsets(grey, pieces, matrix, final_reach)
    is_near = np.abs(offsets) <= _NEAR_PX
    covered = (strengths > 0) & is_near
    lengths = np.bincount(pieces.line, pieces.lengths)
    covered_lengths = np.bincount(pieces.line, pieces.lengths * covered)
    coverage = covered_lengths.sum() / lengths.sum()
    return Fit(
        matrix,
        coverage=float(coverage),
        line_coverage=covered_lengths / lengths,
        log_sd=_size_error(jacobian[covered], offsets[covered]),
    )


def _size_error(jacobian: Jacobian, residuals: Offsets) -> float:
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
    mean_square = np.mean(residuals**2)
    residual_px = max(float(np.sqrt(mean_square)), _MIN_RESIDUAL_PX)
    covariance = residual_px**2 * np.linalg.inv(normal)
    return math.sqrt(covariance[_SIZE, _SIZE])


def _line_offsets(
    grey: GreyImage, pieces: _Pieces, matrix: Matrix, reach_px: float
) -> tuple[Offsets, NDArray[np.float64]]:
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
    first = -reach_px - _FLANK_PX
    last = reach_px + _FLANK_PX
    across = np.arange(first, last + _STEP_PX / 2, _STEP_PX)
    profiles = _profiles(grey, starts, ends, across)

    # A line is brighter than the profile on both sides of it.
    flank = round(_FLANK_PX / _STEP_PX)
    inner = profiles[:, flank:-flank]
    before = profiles[:, : -2 * flank]
    after = profiles[:, 2 * flank :]
    ridges = inner - np.maximum(before, after)
    peaks = _highest(ridges)
    inner_across = across[flank:-flank]
    offsets = inner_across[peaks.columns] + peaks.shifts * _STEP_PX

    # A peak at the end of the profile, or a piece outside the image, shows no line.
    steps = np.diff(inner[:, ::4], axis=1)
    noise = float(np.median(np.abs(steps)))
    min_contrast = max(_MIN_CONTRAST, _CONTRAST_PER_NOISE * noise)
    last_column = ridges.shape[1] - 1
    at_end = (peaks.columns == 0) | (peaks.columns == last_column)
    height, width = grey.shape
    last_pixel = (width - 1, height - 1)
    is_inside = (starts >= 0) & (starts <= last_pixel)
    shows_no_line = at_end | ~is_inside.all(axis=1)
    contrasts = (peaks.heights - min_contrast) / min_contrast
    strengths = np.where(shows_no_line, 0.0, np.clip(contrasts, 0, 1))
    return offsets, strengths


class _Peaks(NamedTuple):
    """Highest value of each row.

    Attributes:
        columns: ``[n]`` columns of the values.
        heights: ``[n]`` the values.
        shifts: ``[n]`` -0.5 to 0.5, from the columns to the peaks of parabolas through the values
            and their neighbours.
    """

    columns: NDArray[np.intp]
    heights: NDArray[np.float32]
    shifts: NDArray[np.float32]


def _highest(ridges: NDArray[np.float32]) -> _Peaks:
    """Find the highest value of each row ``[n, m]``."""
    rows = np.arange(len(ridges))
    last_column = ridges.shape[1] - 1
    columns = ridges.argmax(axis=1)
    left_columns = np.maximum(columns - 1, 0)
    right_columns = np.minimum(columns + 1, last_column)
    heights = ridges[rows, columns]
    left = ridges[rows, left_columns]
    right = ridges[rows, right_columns]
    # The vertex of the parabola; a plateau has no bend.
    bends = left - 2 * heights + right
    bends = np.minimum(bends, -1e-6)
    shifts = (left - right) / (2 * bends)
    return _Peaks(columns, heights=heights, shifts=np.clip(shifts, -0.5, 0.5))


def _profiles(
    grey: GreyImage, starts: Points, ends: Points, across: Offsets
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
    along = ends - starts
    longest_px = np.hypot(*along.T).max()
    count = int(np.clip(longest_px, 2, _MAX_SAMPLES))
    samples = np.arange(count) + 0.5
    shares = samples[:, None, None] / count
    points = (1 - shares) * starts + shares * ends  # [count, n, 2]
    normals = _normals(starts, ends)
    # Two planes of coordinates take a third of the time of pairs.
    shape = (count, len(starts), len(across))
    planes = np.empty((2, *shape), np.float32)
    for axis, plane in enumerate(planes):
        along_piece = points[:, :, None, axis]
        np.add(along_piece, across * normals[:, None, axis], out=plane)
    x, y = planes.reshape(2, count, -1)
    sampled = cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    samples_along = sampled.reshape(shape)
    return np.asarray(samples_along.mean(axis=0))


def _normals(starts: Points, ends: Points) -> Points:
    """Compute the unit normals ``[n, 2]`` of pieces."""
    x, y = (ends - starts).T
    across = np.stack([-y, x], axis=1)
    lengths = np.hypot(x, y)
    return np.asarray(across / lengths[:, None])


def _jacobian(pieces: _Pieces, matrix: Matrix, freedom: int) -> Jacobian:
    """Compute the motion of each piece along its normal, for a unit of each motion.

    Returns:
        ``[pieces, freedom]`` pixels.
    """
    starts = project(matrix, pieces.starts)
    ends = project(matrix, pieces.ends)
    normals = _normals(starts, ends)
    middles = project(matrix, pieces.middles)
    nudged = project(matrix @ _NUDGES[:freedom], pieces.middles)
    shifts = nudged - middles
    along_normals = (shifts * normals).sum(axis=2)
    return np.ascontiguousarray(along_normals.T / _EPSILON)


def _solve(
    jacobian: Jacobian, offsets: Offsets, weights: NDArray[np.float64]
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
        relative = residuals / width
        biweight = (1 - relative**2) ** 2
        is_inlier = np.abs(residuals) < width
        trust = weights * np.where(is_inlier, biweight, 0.0)
        weighted = (jacobian * trust[:, None]).T
        normal = weighted @ jacobian
        # A little damping, in case no piece shows one of the motions.
        damping = 1e-9 * np.trace(normal) / n_motions
        normal += damping * np.eye(n_motions)
        try:
            solution = np.linalg.solve(normal, weighted @ offsets)
        except np.linalg.LinAlgError:
            return None
        motion = np.asarray(solution, np.float64)
    return motion
