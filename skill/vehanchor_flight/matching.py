"""Matching of two overlapping photographs: similarity transform and ratio of scales."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor_flight.features import Features

    Points: TypeAlias = NDArray[np.float64]
    """Points x, y ``[n, 2]`` in pixels."""

    Point: TypeAlias = NDArray[np.float64]
    """Point x, y ``[2]`` in pixels."""

    Matches: TypeAlias = NDArray[np.intp]
    """Pairs ``[k, 2]`` of indices of features."""

    Transform: TypeAlias = NDArray[np.float64]
    """Similarity transform ``[2, 3]``."""

    Descriptors: TypeAlias = NDArray[np.uint8]
    """RootSIFT descriptors ``[n, 128]``."""

    Products: TypeAlias = NDArray[np.float32]
    """Products ``[n, m]`` of the descriptors of two photographs."""

_MIN_INLIERS = 14
_MIN_INLIER_SHARE = 0.12
_MIN_FEATURES = 4 * _MIN_INLIERS  # Photographs with fewer may have no match. A choice.
_MAX_DISTANCE_RATIO = 0.9  # Lowe's ratio test: best match over second-best match.
_TOLERANCE_PX = 4.0  # Of the reduced copies: displacement by relief and lens.
_RANSAC_CONFIDENCE = 0.999
_MAX_RANSAC_TRIALS = 2000
_MAX_SCALE_RATIO = 6.0
_LOG_SD = 0.01  # Error of the log ratio by relief, lens and slight tilt.
_DIGITS = 9  # Of the fit; further digits depend on threads and memory layout.
_SHAPE_SHARE = 0.25  # Of the difference between the scales along and across, a sign of tilt.
_MAX_SHAPE_SD = 0.2
_DESCRIPTOR_LENGTH = 255.0  # Norm of RootSIFT descriptors, stored as uint8.


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
    turn: Transform
    first_at: Point
    second_at: Point


class Overlap(NamedTuple):
    """Two photographs with a match; both by index."""

    first: int
    second: int
    match: Match


def can_match(features: Features) -> bool:
    """Check whether a photograph has enough features to be matched safely.

    Of the features of two photographs of the same ground, half or fewer agree.
    """
    return len(features) >= _MIN_FEATURES


def shifted(centre: Point, shift: Point) -> Match:
    """Make the match of two photographs that differ by a shift only.

    Args:
        centre: ``[2]`` of both, pixels.
        shift: ``[2]`` from the first to the second, pixels.
    """
    turn = np.column_stack([np.eye(2), shift])
    return Match(
        0.0,
        _LOG_SD,
        n=_MIN_INLIERS,
        turn=turn,
        first_at=centre,
        second_at=centre + shift,
    )


def match(first: Features, second: Features) -> Match | None:
    """Find the similarity transform between two photographs.

    Bands of one shot, such as near infrared or thermal ones, show bright what others show dark.

    Args:
        first: features of one.
        second: features of the other.

    Returns:
        The match; None if too few points agree.
    """
    products = _products(first.descriptors, second.descriptors)
    matched = _match_nearest(first, second, products)
    if matched is not None:
        return matched
    reversed_products = _products(first.descriptors, _of_negative(second.descriptors))
    return _match_nearest(first, second, np.maximum(products, reversed_products))


def _of_negative(descriptors: Descriptors) -> Descriptors:
    """Compute the descriptors ``[n, 128]`` of the same points in the negative.

    All gradients turn by half, and so does the direction of each point. Relative to it the
    gradients stay, and the 4 by 4 cells are turned.
    """
    cells = descriptors.reshape(-1, 4, 4, 8)
    return cells[:, ::-1, ::-1].reshape(descriptors.shape)


def _match_nearest(first: Features, second: Features, products: Products) -> Match | None:
    """Match two photographs by the products ``[n, m]`` of their descriptors."""
    pairs = _nearest(products)
    if len(pairs) < _MIN_INLIERS:
        return None
    first_points = first.points[pairs[:, 0]]
    second_points = second.points[pairs[:, 1]]
    # RANSAC ignores pairs of different things that look alike.
    fitted, inlier_column = cv2.estimateAffinePartial2D(
        first_points,
        second_points,
        method=cv2.RANSAC,
        ransacReprojThreshold=_TOLERANCE_PX * second.pixel,
        maxIters=_MAX_RANSAC_TRIALS,
        confidence=_RANSAC_CONFIDENCE,
    )
    if fitted is None:
        return None
    is_inlier = inlier_column.ravel().astype(bool)
    n_inliers = int(is_inlier.sum())
    n_needed = max(_MIN_INLIERS, _MIN_INLIER_SHARE * len(pairs))
    if n_inliers < n_needed:
        return None
    exact_transform = np.asarray(fitted, dtype=np.float64)
    transform: Transform = exact_transform.round(_DIGITS)
    # A similarity maps the unit vector in x to one as long as the ratio of the scales.
    x_axis = transform[:, 0]
    ratio = math.hypot(x_axis[0], x_axis[1])
    if not 1 / _MAX_SCALE_RATIO <= ratio <= _MAX_SCALE_RATIO:
        return None
    first_points = first_points[is_inlier]
    second_points = second_points[is_inlier]
    exact_log_sd = _log_ratio_sd(first_points, second_points, transform)
    log_sd = round(exact_log_sd, _DIGITS)
    return Match(
        math.log(ratio),
        log_sd,
        n=n_inliers,
        turn=transform,
        first_at=first_points.mean(axis=0),
        second_at=second_points.mean(axis=0),
    )


def _products(first: Descriptors, second: Descriptors) -> Products:
    """Multiply the descriptors of two photographs, ``[n, m]``."""
    rows = first.astype(np.float32)
    columns = second.astype(np.float32)
    return np.asarray(rows @ columns.T)


def _nearest(products: Products) -> Matches:
    """Find mutual best matches that pass the ratio test.

    Args:
        products: ``[n, m]`` of the descriptors of two photographs.

    Returns:
        ``[k, 2]`` pairs of indices.
    """
    if min(products.shape) < 2:
        return np.zeros((0, 2), np.intp)
    # All descriptors have one length L, so that their squared distance is 2 (L^2 - product).
    products = products.copy()
    rows = np.arange(len(products))
    best = products.argmax(axis=1)
    best_of_second = products.argmax(axis=0)
    is_mutual = best_of_second[best] == rows
    best_products = products[rows, best]
    products[rows, best] = -math.inf
    second_best_products = products.max(axis=1)
    squared_length = _DESCRIPTOR_LENGTH**2
    best_distances = np.maximum(2 * (squared_length - best_products), 0.0)
    second_best_distances = np.maximum(2 * (squared_length - second_best_products), 1e-6)
    # The distances are squared, so the ratio is, too.
    max_distances = _MAX_DISTANCE_RATIO**2 * second_best_distances
    is_distinct = best_distances <= max_distances
    matched = np.flatnonzero(is_mutual & is_distinct)
    return np.column_stack([matched, best[matched]])


def _log_ratio_sd(first: Points, second: Points, transform: Transform) -> float:
    """Compute the standard deviation of the log ratio of two photographs' scales.

    Args:
        first: ``[n, 2]`` matched points in one photograph.
        second: ``[n, 2]`` the same points in the other.
        transform: ``[2, 3]`` similarity transform from the first to the second.
    """
    # Scatter: the error of a length is that of n points over their distance from the middle.
    rotation = transform[:, :2]
    shift = transform[:, 2]
    mapped = first @ rotation.T + shift
    error = _rms(mapped - second)
    middle = second.mean(axis=0)
    radius = _rms(second - middle)
    root_of_n = math.sqrt(2 * len(first))
    scatter_sd = error / (radius * root_of_n)
    # Shape: an affine fit has two singular values, and a tilt of the camera makes them differ.
    centred = first - first.mean(axis=0)
    ones = np.ones(len(first))
    design = np.column_stack([centred, ones])
    affine, *_ = np.linalg.lstsq(design, second, rcond=None)
    # Singular values of the linear part: the scales along and across.
    linear = affine[:2]
    largest, smallest = np.linalg.svd(linear, compute_uv=False)
    along = max(largest, 1e-9)
    across = max(smallest, 1e-9)
    stretch = math.log(along / across)
    shape_sd = min(_SHAPE_SHARE * stretch, _MAX_SHAPE_SD)
    return math.sqrt(scatter_sd**2 + shape_sd**2 + _LOG_SD**2)


def _rms(vectors: Points) -> float:
    """Compute the root mean square length of vectors ``[n, 2]``."""
    squares = (vectors**2).sum(axis=1)
    return math.sqrt(float(squares.mean()))
