"""Oriented boxes: geometry, exact IoU and non-maximum suppression.

A box is a row ``(x, y, length, width, angle)``: centre in pixels, the two sides in pixels with
``length >= width``, and the angle of the long side in radians, counted from +x towards +y (image
axes: x right, y down), in [0, pi).
"""

from __future__ import annotations

from itertools import combinations_with_replacement
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.errors import ModelContractError
from vehanchor.scale.defaults import NMS_IOU

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

# at smaller angles the closed form for parallel boxes errs by less than 0.001 in IoU
_PARALLEL_RAD = 2e-4
_BLOCK_OVERLAPS = 16_384  # pairs whose overlaps are computed at once, in 30 MiB
_FEW_PAIRS = 1 << 20  # that are compared at once, in 30 MiB
_MOST_CELLS = 1 << 20  # of a column, and columns
_MOST_PAIRS = 20_000_000  # that are near each other


def canonical_boxes(boxes: ArrayLike) -> NDArray[np.float64]:
    """Convert boxes to canonical form: the long side first, the angle in [0, pi).

    Args:
        boxes: ``[n, 5]`` rows ``(x, y, w, h, angle)``, the angle of the ``w`` side in radians; ``w
            >= h`` not required.

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
        [
            centre - along - across,
            centre + along - across,
            centre + along + across,
            centre - along + across,
        ],
        axis=1,
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


def pair_iou(first: NDArray[np.float64], second: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the exact IoU of canonical boxes, pair by pair.

    Args:
        first: ``[k, 5]`` canonical boxes.
        second: ``[k, 5]`` canonical boxes.

    Returns:
        ``[k]`` float64 in [0, 1].
    """
    turn = second[:, 4] - first[:, 4]
    cosine = np.cos(turn)
    sine = np.sin(turn)
    shift = _turned((second[:, :2] - first[:, :2]).T, np.cos(first[:, 4]), -np.sin(first[:, 4]))
    half_a = first[:, 2:4].T / 2
    half_b = second[:, 2:4].T / 2
    # of parallel boxes, in the frames of a
    along_b = np.where(np.abs(cosine) < np.abs(sine), half_b[::-1], half_b)
    sides = np.clip(half_a + along_b - np.abs(shift), 0, 2 * np.minimum(half_a, along_b))
    parallel = np.minimum(np.abs(cosine), np.abs(sine)) < _PARALLEL_RAD
    with np.errstate(divide="ignore", invalid="ignore"):  # of boxes without a width
        shared = np.where(
            parallel,
            sides[0] * sides[1],
            _slanted_overlap(half_a, half_b, shift=shift, cosine=cosine, sine=sine),
        )
        iou = shared / (4 * (half_a.prod(axis=0) + half_b.prod(axis=0)) - shared)
    return np.asarray(np.clip(np.nan_to_num(iou, nan=0.0), 0.0, 1.0))


def _turned(
    vectors: NDArray[np.float64], cosine: NDArray[np.float64], sine: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Turn vectors ``[2, ..., k]`` by angles."""
    x, y = vectors
    return np.stack([x * cosine - y * sine, x * sine + y * cosine])


def _slanted_overlap(
    half_a: NDArray[np.float64],
    half_b: NDArray[np.float64],
    shift: NDArray[np.float64],
    cosine: NDArray[np.float64],
    sine: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Compute the area that boxes with no parallel sides share, by Green's theorem.

    The shared polygon is bounded by the parts of each box's edges that lie in the other box. Each
    part adds half the cross product of its ends about the first centre.

    Args:
        half_a: ``[2, k]`` half sides of the first boxes.
        half_b: ``[2, k]`` half sides of the second boxes.
        shift: ``[2, k]`` centres of the second boxes in the frames of the first.
        cosine: ``[k]`` of the angle from the first box to the second.
        sine: ``[k]`` of that angle.

    Returns:
        ``[k]`` areas.
    """
    # of the corners, in order around the box
    signs = np.array([[-1, 1, 1, -1], [-1, -1, 1, 1]])[:, :, None]
    corners_b = shift[:, None] + _turned(signs * half_b[:, None], cosine, sine)
    corners_a = _turned(signs * half_a[:, None] - shift[:, None], cosine, -sine)
    edges_b = np.roll(corners_b, -1, axis=1) - corners_b
    edges_a = np.roll(corners_a, -1, axis=1) - corners_a
    cross_b = corners_b[0] * edges_b[1] - corners_b[1] * edges_b[0]
    cross_a = 2 * half_a.prod(axis=0)  # of every edge
    shares_b = _share_inside(corners_b, edges_b, half_a)
    shares_a = _share_inside(corners_a, edges_a, half_b)
    area: NDArray[np.float64] = (
        (shares_b * cross_b).sum(axis=0) + shares_a.sum(axis=0) * cross_a
    ) / 2
    return area


def _share_inside(
    corners: NDArray[np.float64], edges: NDArray[np.float64], half: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Compute the share ``[4, k]`` of each edge ``[2, 4, k]`` from its corner that lies in a box around the origin."""
    sides = half[:, None]
    enter = (-np.copysign(sides, edges) - corners) / edges
    leave = (np.copysign(sides, edges) - corners) / edges
    inside: NDArray[np.float64] = np.minimum(leave.min(axis=0), 1) - np.maximum(
        enter.max(axis=0), 0
    )
    return np.maximum(inside, 0)


def oriented_iou(a: ArrayLike, b: ArrayLike) -> NDArray[np.float64]:
    """Compute the exact intersection over union of every box of ``a`` with every box of ``b``.

    Args:
        a: ``[n, 5]`` boxes.
        b: ``[m, 5]`` boxes.

    Returns:
        ``[n, m]`` float64 in [0, 1].
    """
    first = canonical_boxes(a)
    second = canonical_boxes(b)
    out = np.zeros((len(first), len(second)))
    radii_a, radii_b = (np.hypot(rows[:, 2], rows[:, 3]) / 2 for rows in (first, second))
    for column, box, radius in zip(out.T, second, radii_b, strict=True):
        # no other circumscribed circles intersect
        near = np.hypot(*(first[:, :2] - box[:2]).T) < radii_a + radius
        column[near] = pair_iou(first[near], np.broadcast_to(box, first[near].shape))
    return out


def box_axes(
    boxes: NDArray[np.float64],
) -> tuple[tuple[NDArray[np.float64], NDArray[np.float64]], ...]:
    """Compute the ends of the long and of the short axis of boxes.

    Args:
        boxes: ``[n, 5]`` rows ``(x, y, length, width, angle)``.

    Returns:
        Two pairs of ``[n, 2]`` points.
    """
    along = np.column_stack([np.cos(boxes[:, 4]), np.sin(boxes[:, 4])])
    across = np.column_stack([-along[:, 1], along[:, 0]])
    reaches = along * boxes[:, 2:3] / 2, across * boxes[:, 3:4] / 2
    return tuple((boxes[:, :2] - reach, boxes[:, :2] + reach) for reach in reaches)


def oriented_nms(
    boxes: ArrayLike, scores: ArrayLike, *, iou_threshold: float = NMS_IOU
) -> NDArray[np.intp]:
    """Suppress non-maximum boxes greedily with exact oriented IoU.

    Boxes are visited by falling score; equal scores by position and size, independent of the
    input's order. A box is dropped if its IoU with a kept box exceeds ``iou_threshold``. Two upper
    bounds of the IoU preselect pairs: the distance of the centres (within and between size
    classes), and the ratio of areas. The exact IoU is computed only for the remaining pairs with
    kept boxes.

    Args:
        boxes: ``[n, 5]`` rows ``(x, y, length, width, angle)``.
        scores: ``[n]`` detection scores.
        iou_threshold: largest IoU that two kept boxes may have; paper: 0.45.

    Returns:
        Indices into ``boxes`` of those kept, from the highest score down.

    Raises:
        ModelContractError: too many boxes overlap; time and memory grow with the square of their
            number.
    """
    rows = canonical_boxes(boxes)
    score = np.asarray(scores, dtype=np.float64).reshape(-1)
    if len(rows) == 0:
        return np.zeros(0, dtype=np.intp)
    order = np.lexsort((*rows.T[::-1], -score))
    rows = rows[order]
    better, worse = _overlap_candidates(rows, iou_threshold)
    kept = np.zeros(len(rows), bool)
    open_ = np.ones(len(rows), bool)
    while len(better):  # each round keeps the boxes that no better open box may overlap
        best = open_.copy()
        best[worse] = False
        kept |= best
        of_best = best[better]
        open_[
            _overlapping(rows, better[of_best], worse=worse[of_best], iou_threshold=iou_threshold)
        ] = False
        open_ &= ~best
        both = open_[better] & open_[worse]
        better = better[both]
        worse = worse[both]
    result: NDArray[np.intp] = order[kept | open_]
    return result


def _overlapping(
    rows: NDArray[np.float64],
    better: NDArray[np.intp],
    worse: NDArray[np.intp],
    iou_threshold: float,
) -> NDArray[np.intp]:
    """List the worse boxes of the pairs whose IoU exceeds the threshold."""
    blocks = [
        slice(start, start + _BLOCK_OVERLAPS) for start in range(0, len(better), _BLOCK_OVERLAPS)
    ]
    return np.concatenate(
        [
            worse[:0],
            *(
                worse[each][pair_iou(rows[better[each]], rows[worse[each]]) > iou_threshold]
                for each in blocks
            ),
        ]
    )


def _overlap_candidates(
    rows: NDArray[np.float64], iou_threshold: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """List the pairs, the earlier box first, that may exceed the threshold, by distance and area ratio."""
    area = rows[:, 2] * rows[:, 3]
    radius = np.maximum(np.hypot(rows[:, 2], rows[:, 3]) / 2, 1e-6)
    # of both areas, which the boxes share at least
    share = iou_threshold / (1 + iou_threshold) * (1 - 1e-9)
    # Two boxes share at most 2 r min(r) of their circles, where r is the overlap along the line of
    # the centres.
    reach = radius - share * area / (2 * radius)
    size_class = np.floor(np.log2(reach)).astype(int)
    members = [np.flatnonzero(size_class == each) for each in np.unique(size_class)]
    found = []
    for c, d in combinations_with_replacement(members, 2):
        i, j = _near_pairs(rows[c, :2], rows[d, :2], reach[c].max() + reach[d].max())
        pairs = np.stack([c[i], d[j]])
        found.append(pairs[:, i < j] if c is d else pairs)
    first, second = np.concatenate(found, axis=1)
    possible = np.minimum(area[first], area[second]) > iou_threshold * np.maximum(
        area[first], area[second]
    )
    possible &= np.hypot(*(rows[second, :2] - rows[first, :2]).T) <= reach[first] + reach[second]
    better, worse = np.sort([first[possible], second[possible]], axis=0)
    return better, worse


def _near_pairs(
    first: NDArray[np.float64], second: NDArray[np.float64], reach: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Find all pairs with a distance of at most ``reach``.

    Points are numbered by cells that are as wide as the reach; a k-d tree of ``scipy`` takes 0.3 s
    to import.

    Args:
        first: ``[n, 2]`` x, y.
        second: ``[m, 2]`` x, y.
        reach: largest distance, > 0.

    Returns:
        Indices ``[k]`` into ``first`` and into ``second``, in no particular order.

    Raises:
        ModelContractError: too many points are near each other; time and memory grow with the
            square of their number.
    """
    points = np.concatenate([first, second]) - np.minimum(first.min(axis=0), second.min(axis=0))
    cells = (points / max(reach, points.max() / _MOST_CELLS)).astype(np.int64) + 1
    own, others = np.split(cells @ (2 * _MOST_CELLS, 1), [len(first)])
    order = np.argsort(others)
    # of three cells in each of three columns
    middles = (own[:, None] + np.array([-2, 0, 2]) * _MOST_CELLS).ravel()
    low = np.searchsorted(others, middles - 1, sorter=order)
    n = np.searchsorted(others, middles + 1, "right", order) - low
    found = []
    for k in np.split(
        np.arange(len(n)), np.searchsorted(np.cumsum(n), np.arange(_FEW_PAIRS, n.sum(), _FEW_PAIRS))
    ):
        i = np.repeat(k // 3, n[k])
        j = order[np.arange(len(i)) + np.repeat(low[k] - np.cumsum(n[k]) + n[k], n[k])]
        found.append(np.stack([i, j])[:, np.hypot(*(first[i] - second[j]).T) <= reach])
        if sum(each.shape[1] for each in found) > _MOST_PAIRS:
            raise ModelContractError(
                f"more than {_MOST_PAIRS} pairs of the detector's {len(first)} boxes may "
                "overlap: it is not a vehicle "
                "detector, or min_score is too low"
            )
    i, j = np.concatenate(found, axis=1)
    return i, j
