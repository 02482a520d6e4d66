"""Shape of a mask: area, perimeter, extents, largest inscribed circle, outline.

All functions are pure and work in pixels. A pixel is a unit square: the first one of an array
spans 0 to 1 in both directions, and a mask is the union of its squares. The area is the number of
pixels, never a polygon's area.

Outlines and distances are computed on a lattice of half pixels. Corners, side midpoints and
centres of the squares are points of this lattice, so the results are exact.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Mask: TypeAlias = NDArray[np.bool_]
    """Pixels of an object, ``[h, w]``."""

    Distances: TypeAlias = NDArray[np.float32]
    """Distances to the background, ``[h, w]``, in cells."""

    Cells: TypeAlias = NDArray[np.uint8]
    """Pixels, or points of a lattice, ``[h, w]``: 1 inside, 0 outside."""

    Ring: TypeAlias = NDArray[np.int32]
    """Corners of a contour, ``[n, 2]`` or ``[n, 1, 2]``, in half cells."""

    Sides: TypeAlias = tuple[bool, bool, bool, bool]
    """Left, top, right and bottom of an array."""

    Bounds: TypeAlias = tuple[int, int, int, int]
    """Smallest box of whole pixels around a mask: x1, y1, x2, y2 from the array's corner."""

    Rings: TypeAlias = list[NDArray[np.float64]]
    """Outline of one piece: x, y ``[n, 2]`` in pixels around the piece, then around each hole."""

MAX_OUTLINE_POINTS = 200
# Smaller steps belong to the pixel grid, not to the object's outline.
PERIMETER_TOLERANCE_PX = 1.2
# Masks with a larger bounding box are reduced before the half-pixel lattice is built.
_MAX_LATTICE_PX = 2_000_000
# Distances that differ by a smaller share are equal; the rest is rounding.
_EQUAL_SHARE = 1e-6
# Tolerance of the outline: the first one, and the factor until few enough points are left.
_OUTLINE_TOLERANCE_PX = 0.5
_TOLERANCE_GROWTH = 1.6
# Simplification leaves at least this many points of a ring at any tolerance.
_MIN_RING_POINTS = 4
# OpenCV needs empty lattice points around a mask. The number is even, so corners stay even.
_RIM = 2
_ALL_SIDES = (True, True, True, True)
# Column of the parent in OpenCV's hierarchy of contours.
_PARENT_COLUMN = 3


class Circle(NamedTuple):
    """Circle, in pixels from the array's corner."""

    x: float
    y: float
    diameter: float


def mask_bounds(mask: Mask) -> Bounds | None:
    """Find the bounding box of a mask ``[h, w]``; None for an empty one."""
    rows = np.flatnonzero(mask.any(axis=1))
    columns = np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return None
    x1 = int(columns[0])
    y1 = int(rows[0])
    x2 = int(columns[-1]) + 1
    y2 = int(rows[-1]) + 1
    return x1, y1, x2, y2


def touches_edge(mask: Mask, sides: Sides = _ALL_SIDES) -> bool:
    """Test whether a mask touches a side of its array.

    Args:
        mask: ``[h, w]``.
        sides: which of left, top, right and bottom count; ``imagery.raster.outer_sides`` gives the
            image's edges.
    """
    left = mask[:, 0]
    top = mask[0]
    right = mask[:, -1]
    bottom = mask[-1]
    lines = (left, top, right, bottom)
    counted = [line for line, counts in zip(lines, sides, strict=True) if counts]
    return any(line.any() for line in counted)


def piece_areas_px(mask: Mask) -> NDArray[np.int64]:
    """Compute the areas in pixels of a mask's 8-connected pieces, the largest first."""
    bounds = mask_bounds(mask)
    if bounds is None:
        return np.zeros(0, dtype=np.int64)
    cells = _crop_to_bounds(mask, bounds)
    _, _, statistics, _ = cv2.connectedComponentsWithStats(cells, connectivity=8)
    # The first component is the background.
    areas = statistics[1:, cv2.CC_STAT_AREA].astype(np.int64)
    return np.sort(areas)[::-1]


def perimeter(mask: Mask) -> float:
    """Compute the length of the outline of a mask ``[h, w]`` with its holes, pixels.

    The sum of the pixels' sides would be 4 / pi too long for a circle. The outline is therefore
    simplified within 1.2 px (Douglas and Peucker). The result is exact for upright rectangles. It
    is within 1 % for straight sides in any direction and for circles of 50 px radius, 2 % at 15 px,
    5 % at 5 px.
    """
    contours = _trace_contours(mask)
    # A reduced mask has larger steps.
    tolerance_px = PERIMETER_TOLERANCE_PX * contours.cell_px
    length = 0.0
    for rings in _simplify(contours, tolerance_px):
        for ring in rings:
            sides = ring - np.roll(ring, 1, axis=0)
            side_lengths = np.linalg.norm(sides, axis=1)
            length += float(side_lengths.sum())
    return length


def rotated_extents(mask: Mask) -> tuple[float, float]:
    """Compute length and width of the smallest rotated rectangle around a mask ``[h, w]``, pixels.

    The rectangle has the smallest area of all that enclose the midpoints of the outer pixels'
    sides. It is exact for upright masks. For slanted ones it leaves out the corners of the pixel
    staircase. The result is (0, 0) for an empty mask.
    """
    bounds = mask_bounds(mask)
    if bounds is None:
        return 0.0, 0.0
    width = bounds[2] - bounds[0]
    height = bounds[3] - bounds[1]
    # A single row or column of pixels is upright.
    if min(width, height) == 1:
        return float(max(width, height)), 1.0
    cells = _crop_to_bounds(mask, bounds)
    _, sides, _ = cv2.minAreaRect(_side_midpoints(cells))
    # The midpoints are in half pixels.
    return max(sides) / 2, min(sides) / 2


def inscribed_circle(mask: Mask) -> Circle | None:
    """Find the largest circle inside a mask ``[h, w]`` and its array; None for an empty mask.

    The radius is the exact Euclidean distance to the nearest background square; the centre is on
    the half-pixel lattice. Masks with a bounding box above two million pixels use whole pixels,
    with an error of up to one pixel in diameter.
    """
    bounds = mask_bounds(mask)
    if bounds is None:
        return None
    cells = np.pad(_crop_to_bounds(mask, bounds), 1)
    if cells.size <= _MAX_LATTICE_PX:
        # A point is free if no background square contains it, borders included.
        free = 1 - _closed_lattice(1 - cells)
        distance = _distance_to_background(free)
        largest = float(distance.max())
        step_px = 0.5
        first_px = 0.0
        # A radius in half pixels is a diameter in pixels.
        diameter_px = largest
    else:
        distance = _distance_to_background(cells)
        largest = float(distance.max())
        step_px = 1.0
        first_px = 0.5
        # Between centres of pixels: the background begins half a pixel before its centre.
        diameter_px = 2 * largest - 1
    # The last bit of OpenCV's result depends on the array's address in memory: take the first of
    # equal circles.
    is_largest = distance >= largest * (1 - _EQUAL_SHARE)
    index = int(np.argmax(is_largest))
    row, column = np.unravel_index(index, distance.shape)
    # The padding adds one pixel before the mask.
    x = float(column) * step_px + first_px - 1
    y = float(row) * step_px + first_px - 1
    left, top, _, _ = bounds
    return Circle(left + x, top + y, diameter_px)


def trace_outline(mask: Mask) -> list[Rings]:
    """Trace the outline of a mask ``[h, w]`` along its pixels' sides, with at most 200 points.

    The outline is simplified (Douglas and Peucker). The tolerance starts at half a pixel and grows
    until the outline has few enough points. Of more than 50 pieces and holes the smallest are left
    out.

    Returns:
        The rings of each piece, the largest piece first.
    """
    contours = _trace_contours(mask)
    n_rings_left = MAX_OUTLINE_POINTS // _MIN_RING_POINTS
    pieces = []
    for rings in contours.pieces:
        largest_rings = rings[:n_rings_left]
        n_rings_left -= len(largest_rings)
        if largest_rings:
            pieces.append(largest_rings)
    contours = contours._replace(pieces=pieces)
    tolerance_px = _OUTLINE_TOLERANCE_PX
    outline = _simplify(contours, tolerance_px)
    while _count_points(outline) > MAX_OUTLINE_POINTS:
        tolerance_px *= _TOLERANCE_GROWTH
        outline = _simplify(contours, tolerance_px)
    return outline


def _count_points(outline: list[Rings]) -> int:
    return sum(len(ring) for rings in outline for ring in rings)


def _crop_to_bounds(mask: Mask, bounds: Bounds) -> Cells:
    x1, y1, x2, y2 = bounds
    part = np.ascontiguousarray(mask[y1:y2, x1:x2])
    return part.view(np.uint8)


def _distance_to_background(free: Cells) -> Distances:
    distance = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(distance, dtype=np.float32)


def _closed_lattice(cells: Cells) -> Cells:
    """Build the half-pixel lattice ``[2h + 1, 2w + 1]`` of cells ``[h, w]``.

    It is 1 on all points of a set square, its border included.
    """
    height, width = cells.shape
    lattice = np.zeros((2 * height + 1, 2 * width + 1), np.uint8)
    lattice[1::2, 1::2] = cells
    square = np.ones((3, 3), np.uint8)
    closed = cv2.dilate(lattice, square)
    return np.asarray(closed, dtype=np.uint8)


def _side_midpoints(cells: Cells) -> Ring:
    """List the midpoints ``[n, 2]`` of the cells' outer sides, x and y in half pixels.

    Each row and each column contributes the outer side of its first and of its last set pixel.
    """
    in_rows = _midpoints_along_rows(cells)
    # In the transposed array, the first coordinate is y.
    in_columns = _midpoints_along_rows(cells.T)[:, ::-1]
    points = np.concatenate([in_rows, in_columns])
    return points.astype(np.int32)


def _midpoints_along_rows(cells: Cells) -> NDArray[np.int64]:
    """List the midpoints ``[n, 2]`` of the first sides of all rows, then of the last ones."""
    rows = np.flatnonzero(cells.any(axis=1))
    set_rows = cells[rows]
    backwards = set_rows[:, ::-1]
    last_column = cells.shape[1] - 1
    first = np.argmax(set_rows, axis=1)
    last = last_column - np.argmax(backwards, axis=1)
    middle_of_row = 2 * rows + 1
    first_sides = np.stack([2 * first, middle_of_row], axis=1)
    last_sides = np.stack([2 * last + 2, middle_of_row], axis=1)
    return np.concatenate([first_sides, last_sides])


class _Contours(NamedTuple):
    """Contours of a mask, before simplification.

    Attributes:
        pieces: rings of each piece, the exterior first: corners ``[n, 1, 2]`` in steps of half a
            cell from ``origin``.
        origin: ``[2]`` x and y of the lattice's first point, pixels from the array's corner.
        cell_px: side of a cell, pixels; more than one for a reduced mask.
    """

    pieces: list[list[Ring]]
    origin: NDArray[np.float64]
    cell_px: int


def _trace_contours(mask: Mask) -> _Contours:
    """Trace contours along the pixels' sides; pieces and their holes by falling size."""
    bounds = mask_bounds(mask)
    if bounds is None:
        return _Contours([], np.zeros(2), 1)
    cells = _crop_to_bounds(mask, bounds)
    # A huge mask is sampled at the middle of larger cells, to bound memory.
    excess = cells.size / _MAX_LATTICE_PX
    cell_px = max(1, math.ceil(math.sqrt(excess)))
    if cell_px > 1:
        middles = slice(cell_px // 2, None, cell_px)
        cells = np.ascontiguousarray(cells[middles, middles])
    lattice = np.pad(_closed_lattice(cells), _RIM)
    contours, hierarchy = cv2.findContours(lattice, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    rings = []
    for contour in contours:
        points = np.asarray(contour, dtype=np.int32).reshape(-1, 2)
        rings.append(_restore_corners(points))
    parents = _parents_of(hierarchy)
    areas = [cv2.contourArea(ring) for ring in rings]
    by_size = sorted(range(len(rings)), key=areas.__getitem__, reverse=True)
    pieces = {k: [rings[k]] for k in by_size if parents[k] < 0}
    for k in by_size:
        if parents[k] >= 0:
            pieces[parents[k]].append(rings[k])
    first_pixel = np.array(bounds[:2])
    origin = first_pixel - _RIM / 2 * cell_px
    return _Contours(list(pieces.values()), origin, cell_px)


def _parents_of(hierarchy: Any) -> list[int]:
    """Return the parent of each ring, negative for an exterior, from OpenCV's hierarchy."""
    # Without rings there is no hierarchy.
    if hierarchy is None:
        return []
    rows = hierarchy.reshape(-1, 4)
    parents: list[int] = rows[:, _PARENT_COLUMN].tolist()
    return parents


def _restore_corners(ring: Ring) -> Ring:
    """Restore the pixel corners that a contour ``[n, 2]`` skips.

    OpenCV steps diagonally past a corner. The skipped corner is the one of the two whose
    coordinates are both even.

    Returns:
        All points, ``[m, 1, 2]``.
    """
    following = np.roll(ring, -1, axis=0)
    is_slanted = (ring != following).all(axis=1)
    is_even = ring % 2 == 0
    corner = np.where(is_even, ring, following)
    # A corner behind every point, then only those of slanted steps.
    with_corners = np.stack([ring, corner], axis=1)
    is_point = np.ones(len(ring), dtype=bool)
    is_kept = np.stack([is_point, is_slanted], axis=1)
    kept = np.ascontiguousarray(with_corners[is_kept])
    return kept.reshape(-1, 1, 2)


def _simplify(contours: _Contours, tolerance_px: float) -> list[Rings]:
    """Simplify contours (Douglas and Peucker), and convert them to pixels from the array's corner.

    A ring that is left with fewer than three points becomes its upright box.
    """
    half_cell_px = contours.cell_px / 2
    tolerance = 2 * tolerance_px / contours.cell_px
    outline = []
    for rings in contours.pieces:
        in_half_cells = [_simplify_ring(ring, tolerance) for ring in rings]
        in_pixels = [contours.origin + ring * half_cell_px for ring in in_half_cells]
        outline.append(in_pixels)
    return outline


def _simplify_ring(ring: Ring, tolerance: float) -> Ring:
    simple = cv2.approxPolyDP(ring, tolerance, True).reshape(-1, 2)
    if len(simple) < 3:
        x1, y1 = ring.min(axis=(0, 1))
        x2, y2 = ring.max(axis=(0, 1))
        corners = [(x1, y1), (x2, y1), (x2, y2), (x1, y2)]
        simple = np.array(corners)
    return np.asarray(simple, dtype=np.int32)
