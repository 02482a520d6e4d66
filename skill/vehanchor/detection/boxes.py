"""Oriented boxes: geometry and exact IoU.

A box is a row ``(x, y, length, width, angle)``: centre in pixels, the two sides in pixels with ``length >= width``, and
the angle of the long side in radians, counted from +x towards +y (image axes: x right, y down), in [0, pi).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np
from scipy.spatial import cKDTree

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

_PARALLEL_RAD = 2e-4  # at smaller angles the closed form for parallel boxes errs by less than 0.001 in IoU


def canonical_boxes(boxes: ArrayLike) -> NDArray[np.float64]:
    """Convert boxes to canonical form: the long side first, the angle in [0, pi).

    Args:
        boxes: ``[n, 5]`` rows ``(x, y, w, h, angle)``, the angle of the ``w`` side in radians; ``w >= h`` not required.

    Returns:
        ``[n, 5]`` float64, the same rectangles as ``(x, y, length, width, angle)``.
    """
    out = np.array(boxes, dtype=np.float64).reshape(-1, 5)
    swap = out[:, 3] > out[:, 2]
    out[swap, 2:4] = out[swap, 3:1:-1]
    out[swap, 4] += np.pi / 2
    out[:, 4] = np.mod(out[:, 4], np.pi)
    out[out[:, 4] >= np.pi, 4] = 0.0  # mod of a tiny negative angle rounds up to pi itself
    return out


def box_corners(boxes: ArrayLike) -> NDArray[np.float64]:
    """Compute the corners of oriented boxes, in order around each box.

    Args:
        boxes: ``[n, 5]`` rows ``(x, y, length, width, angle)``, pixels and radians.

    Returns:
        ``[n, 4, 2]`` float64 x, y in pixels.
    """
    rows = np.asarray(boxes, dtype=np.float64).reshape(-1, 5)
    along = rows[:, 2:3] / 2 * np.stack([np.cos(rows[:, 4]), np.sin(rows[:, 4])], axis=1)
    across = rows[:, 3:4] / 2 * np.stack([-np.sin(rows[:, 4]), np.cos(rows[:, 4])], axis=1)
    centre = rows[:, :2]
    return np.stack(
        [centre - along - across, centre + along - across, centre + along + across, centre - along + across], axis=1
    )


def boxes_from_corners(corners: ArrayLike) -> NDArray[np.float64]:
    """Convert four corners per box, as in DOTA's text labels, to oriented boxes.

    Opposite sides are averaged: labels that are not quite rectangular keep their mean length.

    Args:
        corners: ``[n, 4, 2]`` or ``[n, 8]`` x, y in pixels, in order around each box.

    Returns:
        ``[n, 5]`` float64 canonical boxes.
    """
    points = np.asarray(corners, dtype=np.float64).reshape(-1, 4, 2)
    first = (points[:, 1] - points[:, 0] + points[:, 2] - points[:, 3]) / 2
    second = (points[:, 2] - points[:, 1] + points[:, 3] - points[:, 0]) / 2
    sides = np.stack([np.linalg.norm(first, axis=1), np.linalg.norm(second, axis=1)], axis=1)
    angle = np.arctan2(first[:, 1], first[:, 0])
    return canonical_boxes(np.column_stack([points.mean(axis=1), sides, angle]))


def pair_iou(boxes: NDArray[np.float64], i: int, j: int) -> float:
    """Compute the exact IoU of two canonical boxes about a local origin (float32 is coarse at 1e5 px).

    Args:
        boxes: ``[n, 5]`` canonical boxes.
        i: index of the first box.
        j: index of the second box.

    Returns:
        In [0, 1].
    """
    a, b = boxes[i], boxes[j]
    shared = _parallel_overlap(a, b)
    if shared is None:
        shared = _slanted_overlap(a, b)
    union = a[2] * a[3] + b[2] * b[3] - shared
    return float(min(shared / union, 1.0)) if union > 0 else 0.0


def _parallel_overlap(a: NDArray[np.float64], b: NDArray[np.float64]) -> float | None:
    """Compute the shared area of two boxes with parallel sides, for which OpenCV loses vertices; else None."""
    turn = b[4] - a[4]
    if abs(math.sin(turn)) < _PARALLEL_RAD:
        along, across = b[2], b[3]
    elif abs(math.cos(turn)) < _PARALLEL_RAD:
        along, across = b[3], b[2]
    else:
        return None
    dx, dy, cosine, sine = b[0] - a[0], b[1] - a[1], math.cos(a[4]), math.sin(a[4])
    shared_along = _overlap(a[2], along, abs(dx * cosine + dy * sine))
    shared_across = _overlap(a[3], across, abs(dy * cosine - dx * sine))
    return shared_along * shared_across


def _overlap(first: float, second: float, distance: float) -> float:
    """Compute the overlap of two intervals from their lengths and the distance of their centres."""
    return max(0.0, min(first, second, (first + second) / 2 - distance))


def _slanted_overlap(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    degrees = 180.0 / math.pi
    kind, region = cv2.rotatedRectangleIntersection(
        ((0.0, 0.0), (a[2], a[3]), a[4] * degrees),
        ((b[0] - a[0], b[1] - a[1]), (b[2], b[3]), b[4] * degrees),
    )
    if kind == cv2.INTERSECT_NONE or region is None:
        return 0.0
    points = region.reshape(-1, 2)  # (k, 2) in OpenCV 5, (k, 1, 2) in 4
    if len(points) < 3:
        return 0.0
    return float(cv2.contourArea(cv2.convexHull(points)))


def oriented_iou(a: ArrayLike, b: ArrayLike) -> NDArray[np.float64]:
    """Compute the exact intersection over union of every box of ``a`` with every box of ``b``.

    Args:
        a: ``[n, 5]`` boxes.
        b: ``[m, 5]`` boxes.

    Returns:
        ``[n, m]`` float64 in [0, 1].
    """
    first, second = canonical_boxes(a), canonical_boxes(b)
    both = np.concatenate([first, second])
    out = np.zeros((len(first), len(second)))
    for i, j in _touching_pairs(first, second):
        out[i, j] = pair_iou(both, i, len(first) + j)
    return out


def _touching_pairs(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.intp]:
    """Find the pairs (i, j) whose circumscribed circles intersect; no other boxes can overlap."""
    if not len(first) or not len(second):
        return np.zeros((0, 2), dtype=np.intp)
    radius_a, radius_b = (np.hypot(rows[:, 2], rows[:, 3]) / 2 for rows in (first, second))
    tree = cKDTree(second[:, :2])
    near: list[list[int]] = tree.query_ball_point(first[:, :2], radius_a + radius_b.max()).tolist()
    i = np.repeat(np.arange(len(first)), [len(n) for n in near])
    j = np.fromiter((k for n in near for k in n), dtype=np.intp, count=len(i))
    gap = np.linalg.norm(first[i, :2] - second[j, :2], axis=1)
    meet = np.flatnonzero(gap < radius_a[i] + radius_b[j])
    return np.column_stack([i[meet], j[meet]])
