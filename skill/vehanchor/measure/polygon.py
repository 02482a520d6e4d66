"""Polygons: area, perimeter, pixels, and whether their lines cross.

All functions are pure and work in pixels; the first pixel spans 0 to 1. A polygon has one part or
several, and each part is a ring around it and a ring around each of its holes.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.segmentation.shape import Bounds, Mask

    Corners: TypeAlias = NDArray[np.float64]
    """Corners of a ring ``[n, 2]``, x and y in order; the last is joined to the first."""

    Part: TypeAlias = Sequence[Corners]
    """The ring around a part, then those around its holes."""

# Sides that are compared at a time with all others near them.
_SIDES_A_BLOCK = 64
# Sides cross if their ends lie apart by more than this share of the squared extent; the rest is
# rounding.
_ROUNDING_SHARE = 1e-12


def area_of(parts: Iterable[Part]) -> float:
    """Compute the area of a polygon by the shoelace formula; holes are left out."""
    area = 0.0
    for exterior, *holes in parts:
        area += _ring_area(exterior)
        for hole in holes:
            area -= _ring_area(hole)
    return area


def _ring_area(ring: Corners) -> float:
    """Compute the area of a ring, in whichever direction it runs."""
    # From its own first corner on, so that large coordinates lose no digits.
    x, y = (ring - ring[0]).T
    next_x = np.roll(x, -1)
    next_y = np.roll(y, -1)
    doubled = np.dot(x, next_y) - np.dot(y, next_x)
    return abs(float(doubled)) / 2


def perimeter_of(parts: Iterable[Part]) -> float:
    """Compute the length of all rings."""
    length = 0.0
    for part in parts:
        for ring in part:
            sides = np.roll(ring, -1, axis=0) - ring
            length += float(np.hypot(*sides.T).sum())
    return length


def extents_of(parts: Iterable[Part]) -> tuple[float, float]:
    """Compute length and width of the smallest rotated rectangle around a polygon."""
    corners = np.concatenate([part[0] for part in parts])
    # OpenCV computes with 32 bits, so the corners are counted from their own first one.
    from_first = (corners - corners[0]).astype(np.float32)
    _, sides, _ = cv2.minAreaRect(from_first)
    return max(sides), min(sides)


def bounds_of(parts: Iterable[Part]) -> Bounds:
    """Return the smallest box of whole pixels around a polygon: x1, y1, x2, y2."""
    corners = np.concatenate([part[0] for part in parts])
    lowest = np.floor(corners.min(axis=0))
    highest = np.ceil(corners.max(axis=0))
    left, top = lowest.astype(int).tolist()
    right, bottom = highest.astype(int).tolist()
    return left, top, right, bottom


def mask_of(parts: Iterable[Part], bounds: Bounds, cells_per_px: int = 1) -> Mask:
    """Find the pixels whose centres lie inside a polygon.

    OpenCV's ``fillPoly`` also paints the pixels that the lines touch, so it is not used.

    Args:
        parts: the polygon.
        bounds: box of whole pixels: x1, y1, x2, y2.
        cells_per_px: cells along a side of a pixel; more than 1 for a finer mask.

    Returns:
        ``[h, w]`` bool, the cells of the box.
    """
    left, top, right, bottom = bounds
    height = (bottom - top) * cells_per_px
    width = (right - left) * cells_per_px
    # A cell is inside if an odd number of sides crosses its row on its left.
    crossings = np.zeros((height, width + 1), dtype=np.uint8)
    for part in parts:
        for ring in part:
            cells = (ring - (left, top)) * cells_per_px
            _count_crossings(crossings, cells)
    odd = np.bitwise_xor.accumulate(crossings[:, :-1], axis=1)
    return odd.view(np.bool_)


def _count_crossings(crossings: NDArray[np.uint8], ring: Corners) -> None:
    """Toggle the first cell behind each crossing of a ring with the middle of a row of cells."""
    height, n_columns = crossings.shape
    starts = ring
    ends = np.roll(ring, -1, axis=0)
    low = np.minimum(starts[:, 1], ends[:, 1])
    high = np.maximum(starts[:, 1], ends[:, 1])
    # The rows whose middles lie between both ends; the lower end counts, the upper one does not.
    first_rows = np.clip(np.ceil(low - 0.5), 0, height).astype(int)
    stop_rows = np.clip(np.ceil(high - 0.5), 0, height).astype(int)
    n_rows = stop_rows - first_rows
    sides = np.repeat(np.arange(len(ring)), n_rows)
    if not len(sides):
        return
    n_before = np.repeat(np.cumsum(n_rows) - n_rows, n_rows)
    rows = np.arange(len(sides)) - n_before + first_rows[sides]
    start_x, start_y = starts[sides].T
    end_x, end_y = ends[sides].T
    share = (rows + 0.5 - start_y) / (end_y - start_y)
    x = start_x + share * (end_x - start_x)
    columns = np.clip(np.ceil(x - 0.5), 0, n_columns - 1).astype(int)
    np.bitwise_xor.at(crossings, (rows, columns), 1)


def find_crossing(rings: Sequence[Corners]) -> tuple[float, float] | None:
    """Find a place where two sides of one or two rings cross; None without any.

    Rings may touch, in corners or along sides.
    """
    starts = np.concatenate(rings)
    ends = np.concatenate([np.roll(ring, -1, axis=0) for ring in rings])
    extent = float(np.ptp(starts, axis=0).max())
    least = _ROUNDING_SHARE * extent**2
    low = np.minimum(starts, ends)
    high = np.maximum(starts, ends)
    n_sides = len(starts)
    for first in range(0, n_sides, _SIDES_A_BLOCK):
        block = slice(first, min(first + _SIDES_A_BLOCK, n_sides))
        # Only sides whose boxes meet the box of the block can cross its sides.
        begins_before = low <= high[block].max(axis=0)
        ends_behind = high >= low[block].min(axis=0)
        is_near = begins_before & ends_behind
        near = first + np.flatnonzero(is_near.all(axis=1)[first:])
        crossing = _first_crossing(
            starts[block, None],
            ends[block, None],
            starts[None, near],
            ends[None, near],
            least,
        )
        if crossing is not None:
            return crossing
    return None


def _first_crossing(
    a: Corners, b: Corners, c: Corners, d: Corners, least: float
) -> tuple[float, float] | None:
    """Find the first crossing of the sides a to b ``[n, 1, 2]`` with c to d ``[1, m, 2]``."""
    # Both ends of each side lie on different sides of the other one.
    turn_to_c = _turn(a, b, c)
    turn_to_d = _turn(a, b, d)
    splits_second = _on_both_sides(turn_to_c, turn_to_d, least)
    turn_to_a = _turn(c, d, a)
    turn_to_b = _turn(c, d, b)
    splits_first = _on_both_sides(turn_to_a, turn_to_b, least)
    crossing = np.argwhere(splits_second & splits_first)
    if not len(crossing):
        return None
    one, other = crossing[0]
    return _meeting_point(a[one, 0], b[one, 0], c[0, other], d[0, other])


def _turn(a: Corners, b: Corners, c: Corners) -> NDArray[np.float64]:
    """Compute twice the signed area of the triangles a, b, c."""
    first = b - a
    second = c - a
    first_x = first[..., 0]
    first_y = first[..., 1]
    second_x = second[..., 0]
    second_y = second[..., 1]
    return np.asarray(first_x * second_y - first_y * second_x)


def _on_both_sides(
    one: NDArray[np.float64], other: NDArray[np.float64], least: float
) -> NDArray[np.bool_]:
    """Test whether two ends, by their turns around a side, lie on different sides of it.

    Args:
        one: turn around the first end.
        other: turn around the second end.
        least: smaller turns are rounding.
    """
    are_apart = (np.abs(one) > least) & (np.abs(other) > least)
    are_opposite = (one > 0) != (other > 0)
    return np.asarray(are_apart & are_opposite)


def _meeting_point(a: Corners, b: Corners, c: Corners, d: Corners) -> tuple[float, float]:
    """Compute where the side a to b meets the line through c and d."""
    turn_to_a = _turn(c, d, a)
    turn_to_b = _turn(c, d, b)
    share = turn_to_a / (turn_to_a - turn_to_b)
    x, y = (a + share * (b - a)).tolist()
    return x, y


def finer_cells(bounds: Bounds, *, side_px: int, most: int) -> int:
    """Choose the cells per pixel with which the longer side of a box has about ``side_px`` cells.

    Args:
        bounds: the box.
        side_px: cells along the longer side.
        most: largest result.
    """
    left, top, right, bottom = bounds
    longer = max(right - left, bottom - top, 1)
    return min(most, max(1, math.floor(side_px / longer)))
