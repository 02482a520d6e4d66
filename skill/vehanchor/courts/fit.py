"""Subpixel fit of a court: every piece of its lines pulls the template to its observed position."""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.courts.match import Pose, Template

# length of line over which the profile is averaged; a player hides one piece, not all
_PIECE_M = 2.4
_STEP_PX = 0.25
_FLANK_PX = 2.0
_REACHES_PX = (4.0, 3.0, 2.5, 2.0, 2.0, 2.0)
_LEAST_CONTRAST = 1.2  # grey levels of the averaged profile
_CONTRAST_PER_NOISE = 0.7
_NEAR_PX = 0.8
_TUKEY_PX = 1.5
_EPSILON = 1e-4

# Small motions of a court in its own metres: along, across, size, rotation; stretch, shear.
_MOTIONS = np.zeros((6, 3, 3))
_MOTIONS[0, 0, 2] = _MOTIONS[1, 1, 2] = 1
_MOTIONS[2, 0, 0] = _MOTIONS[2, 1, 1] = 1
_MOTIONS[3, 1, 0], _MOTIONS[3, 0, 1] = 1, -1
_MOTIONS[4, 0, 0], _MOTIONS[4, 1, 1] = 1, -1
_MOTIONS[5, 1, 0] = _MOTIONS[5, 0, 1] = 1
_NUDGES = np.eye(3) + _EPSILON * _MOTIONS
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
        return float(
            max(abs(math.log(along / across)), abs(local[:, 0] @ local[:, 1]) / (along * across))
        )


def pose_matrix(pose: Pose) -> NDArray[np.float64]:
    """Build the matrix ``[3, 3]`` from metres on a court to pixels."""
    cos = math.cos(pose.angle) * pose.px_per_m
    sin = math.sin(pose.angle) * pose.px_per_m
    return np.array([[cos, -sin, pose.x], [sin, cos, pose.y], [0.0, 0.0, 1.0]])


def project(matrix: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Project points ``[n, 2]`` through a matrix ``[3, 3]``, or through each of ``[k, 3, 3]``."""
    return np.asarray(points @ matrix[..., :2, :2].swapaxes(-1, -2) + matrix[..., None, :2, 2])


class _Pieces(NamedTuple):
    """Pieces of a template: ``[n, 2]`` ends and middles in metres, ``[n]`` lengths and line indices."""

    starts: NDArray[np.float64]
    ends: NDArray[np.float64]
    middles: NDArray[np.float64]
    lengths: NDArray[np.float64]
    line: NDArray[np.intp]


@cache
def _cut(template: Template) -> _Pieces:
    starts = []
    ends = []
    which = []
    for index, line in enumerate(np.concatenate([template.lines, template.arcs])):
        count = max(1, round(np.hypot(line[2] - line[0], line[3] - line[1]) / _PIECE_M))
        at = np.linspace(0, 1, count + 1)[:, None]
        points = (1 - at) * line[:2] + at * line[2:]
        starts.append(points[:-1])
        ends.append(points[1:])
        which += [index] * count
    first = np.concatenate(starts)
    last = np.concatenate(ends)
    return _Pieces(
        first,
        last,
        middles=(first + last) / 2,
        lengths=np.hypot(*(last - first).T),
        line=np.array(which),
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
    for reach in _REACHES_PX:
        offsets, strengths = _seen(grey, pieces, matrix, reach)
        jacobian = _jacobian(pieces, matrix, freedom)
        motion = _solve(jacobian, offsets, strengths * pieces.lengths)
        if motion is None:
            break
        matrix = matrix @ (np.eye(3) + np.tensordot(motion, _MOTIONS[: len(motion)], axes=1))
    offsets, strengths = _seen(grey, pieces, matrix, _REACHES_PX[-1])
    near = (strengths > 0) & (np.abs(offsets) <= _NEAR_PX)
    total = np.bincount(pieces.line, pieces.lengths)
    covered = np.bincount(pieces.line, pieces.lengths * near)
    log_sd = math.inf
    if near.sum() > freedom:
        normal = jacobian[near].T @ jacobian[near]
        if np.linalg.cond(normal) < 1e12:
            residual = float(np.sqrt(np.mean(offsets[near] ** 2)))
            log_sd = math.sqrt((max(residual, 0.1) ** 2 * np.linalg.inv(normal))[2, 2])
    return Fit(
        matrix, float(covered.sum() / total.sum()), line_coverage=covered / total, log_sd=log_sd
    )


def _seen(
    grey: NDArray[np.float32], pieces: _Pieces, matrix: NDArray[np.float64], reach_px: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Measure the offset of the visible line from each piece, in pixels along its normal, and its strength, 0..1."""
    starts = project(matrix, pieces.starts)
    ends = project(matrix, pieces.ends)
    count = int(np.clip(np.hypot(*(ends - starts).T).max(), 2, 64))
    at = (np.arange(count) + 0.5)[:, None, None] / count
    points = (1 - at) * starts + at * ends  # [count, pieces, 2]
    across = np.arange(-reach_px - _FLANK_PX, reach_px + _FLANK_PX + _STEP_PX / 2, _STEP_PX)
    normals = _normals(starts, ends)
    # planes take a third of the time of pairs
    where = np.empty((2, count, len(starts), len(across)), np.float32)
    for axis, plane in enumerate(where):
        np.add(points[:, :, None, axis], across * normals[:, None, axis], out=plane)
    x, y = where.reshape(2, count, -1)
    sampled = cv2.remap(grey, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    profile = sampled.reshape(where.shape[1:]).mean(axis=0)
    flank = round(_FLANK_PX / _STEP_PX)
    inner = profile[:, flank:-flank]
    ridge = inner - np.maximum(profile[:, : -2 * flank], profile[:, 2 * flank :])
    peak = ridge.argmax(axis=1)
    each = np.arange(len(peak))
    height = ridge[each, peak]
    left = ridge[each, np.maximum(peak - 1, 0)]
    right = ridge[each, np.minimum(peak + 1, ridge.shape[1] - 1)]
    bend = np.minimum(left - 2 * height + right, -1e-6)
    shift = np.clip((left - right) / (2 * bend), -0.5, 0.5)
    offsets = across[flank:-flank][peak] + shift * _STEP_PX
    noise = np.median(np.abs(np.diff(inner[:, ::4], axis=1)))
    least = max(_LEAST_CONTRAST, _CONTRAST_PER_NOISE * float(noise))
    edge = (peak == 0) | (peak == ridge.shape[1] - 1)
    inside = ((starts >= 0) & (starts <= np.array(grey.shape[::-1]) - 1)).all(axis=1)
    clear = np.where(edge | ~inside, 0.0, np.clip((height - least) / least, 0, 1))
    return offsets, clear


def _normals(starts: NDArray[np.float64], ends: NDArray[np.float64]) -> NDArray[np.float64]:
    along = ends - starts
    return np.asarray(np.stack([-along[:, 1], along[:, 0]], axis=1) / np.hypot(*along.T)[:, None])


def _jacobian(pieces: _Pieces, matrix: NDArray[np.float64], freedom: int) -> NDArray[np.float64]:
    """Compute the motion of each piece along its normal in pixels for a unit of each motion: ``[pieces, freedom]``."""
    normals = _normals(project(matrix, pieces.starts), project(matrix, pieces.ends))
    moved = project(matrix @ _NUDGES[:freedom], pieces.middles) - project(matrix, pieces.middles)
    return np.ascontiguousarray((moved * normals).sum(axis=2).T / _EPSILON)


def _solve(
    jacobian: NDArray[np.float64], offsets: NDArray[np.float64], weights: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Solve for the motion that moves the pieces onto the lines, without outliers (Tukey's biweight)."""
    if (weights > 0).sum() <= jacobian.shape[1]:
        return None
    motion: NDArray[np.float64] = np.zeros(jacobian.shape[1])
    for turn in range(4):
        off = offsets - jacobian @ motion
        width = _TUKEY_PX * (3 - min(turn, 2))
        trust = weights * np.where(np.abs(off) < width, (1 - (off / width) ** 2) ** 2, 0.0)
        trusted = (jacobian * trust[:, None]).T
        left = trusted @ jacobian
        left += 1e-9 * np.trace(left) / len(left) * np.eye(len(left))
        try:
            motion = np.asarray(np.linalg.solve(left, trusted @ offsets), np.float64)
        except np.linalg.LinAlgError:
            return None
    return motion
