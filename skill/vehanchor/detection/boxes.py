"""Oriented boxes: geometry, exact IoU and non-maximum suppression.

A box is a row ``(x, y, length, width, angle)``: centre in pixels, the two sides in pixels with
``length >= width``, and the angle of the long side in radians, counted from +x towards +y (image
axes: x right, y down), in [0, pi).
"""

from __future__ import annotations

from itertools import combinations_with_replacement
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from vehanchor.errors import ModelContractError
from vehanchor.scale.defaults import NMS_IOU

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Boxes: TypeAlias = NDArray[np.float64]
    """``[n, 5]`` rows ``(x, y, length, width, angle)``, pixels and radians."""

    Corners: TypeAlias = NDArray[np.float64]
    """``[n, 4, 2]`` x, y in pixels, in order around each box."""

    Vectors: TypeAlias = NDArray[np.float64]
    """``[2, ..., k]`` x and y, pixels."""

    Lengths: TypeAlias = NDArray[np.float64]
    """``[k]`` or ``[2, k]`` lengths, pixels."""

    Cosines: TypeAlias = NDArray[np.float64]
    """``[k]`` cosines or sines of angles."""

    Overlaps: TypeAlias = NDArray[np.float64]
    """Intersection over union of boxes, 0..1."""

    Indices: TypeAlias = NDArray[np.intp]
    """``[k]`` indices of boxes."""

# At smaller angles the closed form for parallel boxes errs by less than 0.001 in IoU.
_PARALLEL_RAD = 2e-4
# Pairs whose overlaps are computed at once, in 30 MiB.
_OVERLAP_BLOCK = 16_384
# Pairs whose distances are compared at once, in 30 MiB.
_PAIR_BLOCK = 1 << 20
# Largest number of pairs that are near each other.
_MAX_PAIRS = 20_000_000
# Largest number of cells along each axis.
_MAX_CELLS = 1 << 20
# Difference between the numbers of neighbouring columns of cells: no row reaches the next column.
_COLUMN_STEP = 2 * _MAX_CELLS


def canonical_boxes(boxes: ArrayLike) -> Boxes:
    """Convert boxes to canonical form: the long side first, the angle in [0, pi).

    Args:
        boxes: ``[n, 5]`` rows ``(x, y, w, h, angle)``, with the angle of the ``w`` side in radians.
            Either side may be the longer one.

    Returns:
        ``[n, 5]`` float64, the same rectangles as ``(x, y, length, width, angle)``.
    """
    rows = np.array(boxes, dtype=np.float64).reshape(-1, 5)
    sides = rows[:, 2:4]
    angles = rows[:, 4]
    is_upright = sides[:, 1] > sides[:, 0]
    sides[is_upright] = sides[is_upright, ::-1]
    angles[is_upright] += np.pi / 2
    np.mod(angles, np.pi, out=angles)
    # The remainder of a tiny negative angle rounds up to pi itself.
    angles[angles >= np.pi] = 0.0
    return rows


def box_corners(boxes: ArrayLike) -> Corners:
    """Compute the corners of oriented boxes, in order around each box.

    Args:
        boxes: ``[n, 5]`` rows ``(x, y, length, width, angle)``, pixels and radians.

    Returns:
        ``[n, 4, 2]`` float64 x, y in pixels.
    """
    rows = np.asarray(boxes, dtype=np.float64).reshape(-1, 5)
    centre = rows[:, :2]
    half_lengths = rows[:, 2:3] / 2
    half_widths = rows[:, 3:4] / 2
    along_axis, across_axis = _unit_axes(rows)
    along = half_lengths * along_axis
    across = half_widths * across_axis
    corners = [
        centre - along - across,
        centre + along - across,
        centre + along + across,
        centre - along + across,
    ]
    return np.stack(corners, axis=1)


def _unit_axes(boxes: Boxes) -> tuple[Vectors, Vectors]:
    """Compute the unit vectors ``[n, 2]`` along and across boxes."""
    angles = boxes[:, 4]
    cosine = np.cos(angles)
    sine = np.sin(angles)
    along = np.column_stack([cosine, sine])
    across = np.column_stack([-sine, cosine])
    return along, across


def boxes_from_corners(corners: ArrayLike) -> Boxes:
    """Convert four corners per box, as in DOTA's text labels, to oriented boxes.

    Opposite sides are averaged: labels that are not quite rectangular keep their mean length.

    Args:
        corners: ``[n, 4, 2]`` or ``[n, 8]`` x, y in pixels, in order around each box.

    Returns:
        ``[n, 5]`` float64 canonical boxes.
    """
    points = np.asarray(corners, dtype=np.float64).reshape(-1, 4, 2)
    a, b, c, d = np.moveaxis(points, 1, 0)
    along = (b - a + c - d) / 2
    across = (c - b + d - a) / 2
    lengths = np.linalg.norm(along, axis=1)
    widths = np.linalg.norm(across, axis=1)
    angles = np.arctan2(along[:, 1], along[:, 0])
    centres = points.mean(axis=1)
    rows = np.column_stack([centres, lengths, widths, angles])
    return canonical_boxes(rows)


def pair_iou(first: Boxes, second: Boxes) -> Overlaps:
    """Compute the exact IoU of canonical boxes, pair by pair.

    Args:
        first: ``[k, 5]`` canonical boxes.
        second: ``[k, 5]`` canonical boxes.

    Returns:
        ``[k]`` float64 in [0, 1].
    """
    first_angles = first[:, 4]
    turn = second[:, 4] - first_angles
    cosine = np.cos(turn)
    sine = np.sin(turn)
    # Centre of the second box in the frame of the first one.
    offset = second[:, :2] - first[:, :2]
    back_cosine = np.cos(first_angles)
    back_sine = -np.sin(first_angles)
    shift = _turned(offset.T, back_cosine, back_sine)
    half_a = first[:, 2:4].T / 2
    half_b = second[:, 2:4].T / 2

    # Boxes with parallel sides share a rectangle; at a quarter turn the sides of b are exchanged.
    cosine_size = np.abs(cosine)
    sine_size = np.abs(sine)
    is_crossed = cosine_size < sine_size
    is_parallel = np.minimum(cosine_size, sine_size) < _PARALLEL_RAD
    half_b_along = np.where(is_crossed, half_b[::-1], half_b)
    shorter = 2 * np.minimum(half_a, half_b_along)
    overlap = half_a + half_b_along - np.abs(shift)
    shared_sides = np.clip(overlap, 0, shorter)

    # Boxes without a width divide by zero.
    with np.errstate(divide="ignore", invalid="ignore"):
        parallel = shared_sides[0] * shared_sides[1]
        slanted = _slanted_overlap(half_a, half_b, shift=shift, cosine=cosine, sine=sine)
        shared = np.where(is_parallel, parallel, slanted)
        quarter_a = half_a.prod(axis=0)
        quarter_b = half_b.prod(axis=0)
        areas = 4 * (quarter_a + quarter_b)
        iou = shared / (areas - shared)
    iou = np.nan_to_num(iou, nan=0.0)
    return np.asarray(np.clip(iou, 0.0, 1.0))


def _turned(vectors: Vectors, cosine: Cosines, sine: Cosines) -> Vectors:
    """Turn vectors ``[2, ..., k]`` by angles."""
    x, y = vectors
    turned_x = x * cosine - y * sine
    turned_y = x * sine + y * cosine
    return np.stack([turned_x, turned_y])


def _slanted_overlap(
    half_a: Lengths, half_b: Lengths, shift: Vectors, cosine: Cosines, sine: Cosines
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
    # Signs of the corners, in order around the box.
    corner_signs = np.array([[-1, 1, 1, -1], [-1, -1, 1, 1]])
    signs = corner_signs[:, :, None]
    # Each box's corners and edges in the frame of the other.
    centre_b = shift[:, None]
    own_corners_a = signs * half_a[:, None]
    own_corners_b = signs * half_b[:, None]
    corners_b = centre_b + _turned(own_corners_b, cosine, sine)
    corners_a = _turned(own_corners_a - centre_b, cosine, -sine)
    edges_b = np.roll(corners_b, -1, axis=1) - corners_b
    edges_a = np.roll(corners_a, -1, axis=1) - corners_a
    # Cross products about the first centre; those of the first box's own edges are all equal.
    x, y = corners_b
    dx, dy = edges_b
    cross_b = x * dy - y * dx
    cross_a = 2 * half_a.prod(axis=0)
    shares_b = _share_inside(corners_b, edges_b, half_a)
    shares_a = _share_inside(corners_a, edges_a, half_b)
    doubled_b = (shares_b * cross_b).sum(axis=0)
    doubled_a = shares_a.sum(axis=0) * cross_a
    return np.asarray((doubled_b + doubled_a) / 2)


def _share_inside(corners: Vectors, edges: Vectors, half: Lengths) -> NDArray[np.float64]:
    """Compute the share of each edge that lies in a box around the origin (Liang and Barsky).

    Args:
        corners: ``[2, 4, k]`` start of each edge.
        edges: ``[2, 4, k]`` vector to its end.
        half: ``[2, k]`` half sides of the box.

    Returns:
        ``[4, k]`` in 0..1.
    """
    # Positions along the edge, 0 to 1, where it enters and leaves the box's two slabs.
    far_sides = np.copysign(half[:, None], edges)
    enter = (-far_sides - corners) / edges
    leave = (far_sides - corners) / edges
    last_inside = np.minimum(leave.min(axis=0), 1)
    first_inside = np.maximum(enter.max(axis=0), 0)
    inside: NDArray[np.float64] = last_inside - first_inside
    return np.maximum(inside, 0)


def oriented_iou(a: ArrayLike, b: ArrayLike) -> Overlaps:
    """Compute the exact intersection over union of every box of ``a`` with every box of ``b``.

    Args:
        a: ``[n, 5]`` boxes.
        b: ``[m, 5]`` boxes.

    Returns:
        ``[n, m]`` float64 in [0, 1].
    """
    first = canonical_boxes(a)
    second = canonical_boxes(b)
    first_radii = _circumradii(first)
    second_radii = _circumradii(second)
    overlaps = np.zeros((len(first), len(second)))
    for column, box, radius in zip(overlaps.T, second, second_radii, strict=True):
        # Boxes whose circumscribed circles are apart do not overlap.
        offsets = first[:, :2] - box[:2]
        distances = np.hypot(*offsets.T)
        is_near = distances < first_radii + radius
        near = first[is_near]
        column[is_near] = pair_iou(near, np.broadcast_to(box, near.shape))
    return overlaps


def _circumradii(boxes: Boxes) -> Lengths:
    """Compute the radii ``[n]`` of the circumscribed circles of boxes."""
    return np.asarray(np.hypot(boxes[:, 2], boxes[:, 3]) / 2)


def box_axes(boxes: Boxes) -> tuple[tuple[Vectors, Vectors], ...]:
    """Compute the ends of the long and of the short axis of boxes.

    Args:
        boxes: ``[n, 5]`` rows ``(x, y, length, width, angle)``.

    Returns:
        Two pairs of ``[n, 2]`` points.
    """
    along, across = _unit_axes(boxes)
    centres = boxes[:, :2]
    half_long = along * boxes[:, 2:3] / 2
    half_short = across * boxes[:, 3:4] / 2
    long_axis = (centres - half_long, centres + half_long)
    short_axis = (centres - half_short, centres + half_short)
    return long_axis, short_axis


def oriented_nms(boxes: ArrayLike, scores: ArrayLike, *, iou_threshold: float = NMS_IOU) -> Indices:
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
    if len(rows) == 0:
        return np.zeros(0, dtype=np.intp)
    falling_score = -np.asarray(scores, dtype=np.float64).reshape(-1)
    # The last key counts first.
    order = np.lexsort((*rows.T[::-1], falling_score))
    rows = rows[order]
    better, worse = _overlap_candidates(rows, iou_threshold)
    is_kept = np.zeros(len(rows), bool)
    is_open = np.ones(len(rows), bool)
    # Each round keeps the open boxes that no better open box may overlap, and drops the boxes that
    # they overlap. The result is that of the greedy loop over single boxes.
    while len(better):
        best = is_open.copy()
        best[worse] = False
        is_kept |= best
        of_best = best[better]

        dropped = _overlapping(
            rows,
            better[of_best],
            worse=worse[of_best],
            iou_threshold=iou_threshold,
        )
        is_open[dropped] = False
        is_open &= ~best
        both_open = is_open[better] & is_open[worse]
        better = better[both_open]
        worse = worse[both_open]
    result: Indices = order[is_kept | is_open]
    return result


def _overlapping(rows: Boxes, better: Indices, worse: Indices, iou_threshold: float) -> Indices:
    """List the worse boxes of the pairs whose IoU exceeds the threshold."""
    overlapping = [worse[:0]]
    for start in range(0, len(better), _OVERLAP_BLOCK):
        block = slice(start, start + _OVERLAP_BLOCK)
        block_worse = worse[block]
        ious = pair_iou(rows[better[block]], rows[block_worse])
        overlapping.append(block_worse[ious > iou_threshold])
    return np.concatenate(overlapping)


def _overlap_candidates(rows: Boxes, iou_threshold: float) -> tuple[Indices, Indices]:
    """List the pairs that may exceed the threshold, by distance and area ratio.

    Returns:
        Indices ``[k]`` of the earlier boxes, and of the later ones.

    Raises:
        ModelContractError: too many boxes overlap.
    """
    areas = rows[:, 2] * rows[:, 3]
    radii = np.maximum(_circumradii(rows), 1e-6)
    # Boxes at the threshold share at least this part of either area.
    share = iou_threshold / (1 + iou_threshold) * (1 - 1e-9)
    # Two boxes share at most 2 r min(r) of their circles, where r is the overlap along the line of
    # the centres. So their distance is at most the sum of these reaches.
    reaches = radii - share * areas / (2 * radii)

    # Boxes of like size are compared with one reach: a huge box must not make all others near.
    octaves = np.floor(np.log2(reaches)).astype(int)
    size_classes = [np.flatnonzero(octaves == octave) for octave in np.unique(octaves)]
    centres = rows[:, :2]
    parts = []
    for some, others in combinations_with_replacement(size_classes, 2):
        reach = reaches[some].max() + reaches[others].max()
        i, j = _near_pairs(centres[some], centres[others], reach)
        pairs = np.stack([some[i], others[j]])
        if some is others:
            # Each pair occurs twice, and each box with itself.
            pairs = pairs[:, i < j]
        parts.append(pairs)
    first, second = np.concatenate(parts, axis=1)

    first_areas = areas[first]
    second_areas = areas[second]
    smaller = np.minimum(first_areas, second_areas)
    larger = np.maximum(first_areas, second_areas)
    offsets = centres[second] - centres[first]
    distances = np.hypot(*offsets.T)
    possible = smaller > iou_threshold * larger
    possible &= distances <= reaches[first] + reaches[second]
    first = first[possible]
    second = second[possible]
    better = np.minimum(first, second)
    worse = np.maximum(first, second)
    return better, worse


def _near_pairs(first: Vectors, second: Vectors, reach: float) -> tuple[Indices, Indices]:
    """Find all pairs with a distance of at most ``reach``.

    Points are in cells as wide as the reach, so that near ones are in the same cell or in two that
    touch. A k-d tree would do the same, but ``scipy``'s takes 0.3 s to import.

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
    points = np.concatenate([first, second])
    from_corner = points - points.min(axis=0)
    cell_px = max(reach, from_corner.max() / _MAX_CELLS)
    columns_and_rows = (from_corner / cell_px).astype(np.int64) + 1
    # Cells of one column have consecutive numbers.
    all_cells = columns_and_rows @ (_COLUMN_STEP, 1)
    cells = all_cells[: len(first)]
    other_cells = all_cells[len(first) :]
    order = np.argsort(other_cells)

    # Runs of candidates in the sorted points: three consecutive cells in each of three columns.
    column_steps = np.array([-1, 0, 1]) * _COLUMN_STEP
    middles = (cells[:, None] + column_steps).ravel()
    first_cells = middles - 1
    last_cells = middles + 1
    starts = np.searchsorted(other_cells, first_cells, sorter=order)
    ends = np.searchsorted(other_cells, last_cells, side="right", sorter=order)
    counts = ends - starts

    # Blocks of runs with about as many pairs, to bound the memory.
    totals = np.cumsum(counts)
    block_ends = np.arange(_PAIR_BLOCK, counts.sum(), _PAIR_BLOCK)
    splits = np.searchsorted(totals, block_ends)
    blocks = np.split(np.arange(len(counts)), splits)
    parts = []
    n_pairs = 0
    for runs in blocks:
        # Number of each pair within its run, by which the run is written out.
        run_counts = counts[runs]
        run_starts = np.cumsum(run_counts) - run_counts
        run_offsets = np.repeat(starts[runs] - run_starts, run_counts)
        i = np.repeat(runs // 3, run_counts)
        j = order[np.arange(len(i)) + run_offsets]
        offsets = first[i] - second[j]
        is_near = np.hypot(*offsets.T) <= reach
        parts.append(np.stack([i[is_near], j[is_near]]))
        n_pairs += int(is_near.sum())
        if n_pairs > _MAX_PAIRS:
            raise ModelContractError(
                f"more than {_MAX_PAIRS} pairs of the detector's {len(first)} boxes may overlap: "
                "it is not a vehicle detector, or min_score is too low"
            )
    i, j = np.concatenate(parts, axis=1)
    return i, j
