"""Matching of two overlapping photographs: similarity transform and ratio of scales."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor_flight.features import Features

_LEAST_INLIERS = 14
_LEAST_INLIER_SHARE = 0.12
_SECOND_BEST = 0.9  # highest ratio of the distances to the best and the second-best match
_TOLERANCE_PX = 4.0  # of the reduced copies: displacement by relief and lens
_CONFIDENCE = 0.999
_TRIALS = 2000
_WIDEST_RATIO = 6.0
_LOG_SD = 0.01  # relief, lens, slight tilt
_DIGITS = 9  # of the fit; the digits behind them depend on threads and memory layout
_SHAPE_SHARE = 0.25  # of the difference between the scales along and across, a sign of tilt


class Match(NamedTuple):
    """Match of two overlapping photographs.

    Attributes:
        log_ratio: natural log of the metres per pixel of the first over those of the second.
        log_sd: its standard deviation.
        n: number of matched points.
        turn: ``[2, 3]`` similarity transform from pixels of the first to pixels of the second.
        first_at: ``[2]`` middle of the matched points in the first, pixels.
        second_at: ``[2]`` middle of the matched points in the second, pixels.
    """

    log_ratio: float
    log_sd: float
    n: int
    turn: NDArray[np.float64]
    first_at: NDArray[np.float64]
    second_at: NDArray[np.float64]


class Overlap(NamedTuple):
    """Two photographs with a match; both by index."""

    first: int
    second: int
    match: Match


def match(first: Features, second: Features) -> Match | None:
    """Find the similarity transform between two photographs.

    Args:
        first: features of one.
        second: features of the other.

    Returns:
        The match; None if too few points agree.
    """
    pairs = _nearest(first.descriptors, second.descriptors)
    if len(pairs) < _LEAST_INLIERS:
        return None
    here = first.points[pairs[:, 0]]
    there = second.points[pairs[:, 1]]
    tolerance = _TOLERANCE_PX * second.pixel
    found, inside = cv2.estimateAffinePartial2D(
        here,
        there,
        method=cv2.RANSAC,
        ransacReprojThreshold=tolerance,
        maxIters=_TRIALS,
        confidence=_CONFIDENCE,
    )
    if found is None:
        return None
    inlier = inside.ravel().astype(bool)
    n = int(inlier.sum())
    if n < _LEAST_INLIERS or n < _LEAST_INLIER_SHARE * len(pairs):
        return None
    turn: NDArray[np.float64] = np.asarray(found, dtype=np.float64).round(_DIGITS)
    scale = math.hypot(turn[0, 0], turn[1, 0])
    if not 1 / _WIDEST_RATIO <= scale <= _WIDEST_RATIO:
        return None
    here = here[inlier]
    there = there[inlier]
    log_sd = round(_spread(here, there, turn), _DIGITS)
    return Match(
        math.log(scale),
        log_sd,
        n=n,
        turn=turn,
        first_at=here.mean(axis=0),
        second_at=there.mean(axis=0),
    )


def _nearest(first: NDArray[np.uint8], second: NDArray[np.uint8]) -> NDArray[np.intp]:
    """Find ``[m, 2]`` pairs of mutual best matches that pass the ratio test."""
    if len(first) < 2 or len(second) < 2:
        return np.zeros((0, 2), np.intp)
    here = first.astype(np.float32)
    there = second.astype(np.float32)
    closeness = here @ there.T  # RootSIFT descriptors have unit length
    best = closeness.argmax(axis=1)
    rows = np.arange(len(here))
    mutual = closeness.argmax(axis=0)[best] == rows
    length = 255.0**2
    nearest = closeness[rows, best]
    closeness[rows, best] = -math.inf
    near = np.maximum(2 * (length - nearest), 0.0)
    next_near = np.maximum(2 * (length - closeness.max(axis=1)), 1e-6)
    chosen = np.flatnonzero(mutual & (near <= _SECOND_BEST**2 * next_near))
    return np.column_stack([chosen, best[chosen]])


def _spread(
    here: NDArray[np.float64], there: NDArray[np.float64], turn: NDArray[np.float64]
) -> float:
    """Compute the standard deviation of the log ratio: by scatter of the points, their shape, and relief."""
    off = here @ turn[:, :2].T + turn[:, 2] - there
    radius = math.sqrt(float(((there - there.mean(axis=0)) ** 2).sum(axis=1).mean()))
    by_points = math.sqrt(float((off**2).sum(axis=1).mean())) / (radius * math.sqrt(2 * len(here)))
    flat = np.column_stack([here - here.mean(axis=0), np.ones(len(here))])
    stretch = np.linalg.svd(np.linalg.lstsq(flat, there, rcond=None)[0][:2], compute_uv=False)
    by_shape = _SHAPE_SHARE * math.log(max(stretch[0], 1e-9) / max(stretch[1], 1e-9))
    return math.sqrt(by_points**2 + min(by_shape, 0.2) ** 2 + _LOG_SD**2)
