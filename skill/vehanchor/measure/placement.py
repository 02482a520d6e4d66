"""Place a circle or a rectangle of fixed proportions in a mask, as large as possible.

The mask is a grid of cells: its pixels, finer cells for a small object, coarser ones for a large
one, or cells of the ground below a tilted camera. A rectangle is tried at 36 headings; those around
the best one are tried in finer steps. For each heading the mask is turned, so that the rectangle is
upright, and the sums of all upright rectangles of one size follow from one integral image.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from vehanchor.measure.polygon import bounds_of, finer_cells, mask_of
from vehanchor.segmentation.shape import inscribed_circle

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.measure.polygon import Corners, Part
    from vehanchor.scale.plane import GroundPlane
    from vehanchor.segmentation.object_mask import ObjectMask
    from vehanchor.segmentation.shape import Mask

    Matrix: TypeAlias = NDArray[np.float64]
    """``[3, 3]`` map of homogeneous points."""

# Cells along the longer side of the mask's box, and most cells along a pixel.
_SIDE_CELLS = 512
_MOST_CELLS_PER_PX = 8
_N_HEADINGS = 36
_HEADING_STEP_DEG = 180 / _N_HEADINGS
# Then the headings beside the best one, by these shares of the step.
_REFINEMENTS = (0.5, 0.25, 0.125, 0.0625)
# Halvings of the interval of sizes: to a thousandth.
_N_HALVINGS = 10
# A heading is searched only if it allows a rectangle larger by this factor.
_LEAST_GAIN = 1.002
_ROUNDING = 1e-9
# A cell is inside if more than half of it is.
_HALF_OPAQUE = 128


@dataclass(frozen=True, eq=False)
class Grid:
    """Mask in cells, and the way back to the image.

    Attributes:
        cells: ``[h, w]`` bool.
        to_image: map from cells (the first spans 0 to 1) to pixels of the image.
        cells_per_px: cells along a pixel of the scale: of the image, or of the rectified ground at
            the scale of the image's centre.
    """

    cells: Mask
    to_image: Matrix
    cells_per_px: float


class PlacedCircle(NamedTuple):
    """Largest circle: its centre in pixels of the image, its diameter in pixels of the scale."""

    centre: tuple[float, float]
    diameter_px: float


@dataclass(frozen=True, eq=False)
class PlacedRectangle:
    """Largest rectangle of its proportions.

    Attributes:
        grid: the mask.
        to_grid: map from the turned cells, in which the rectangle is upright, to cells of the grid.
        turned: ``[h, w]`` the turned cells.
        centre: its centre in the turned cells.
        length_px: its length, in pixels of the scale.
        width_px: its width, in pixels of the scale.
    """

    grid: Grid
    to_grid: Matrix
    turned: Mask
    centre: tuple[float, float]
    length_px: float
    width_px: float

    def corners(self, length_px: float, width_px: float) -> Corners:
        """Place a rectangle of another size at the same centre and heading.

        Returns:
            ``[4, 2]`` its corners in pixels of the image.
        """
        half_length = length_px * self.grid.cells_per_px / 2
        half_width = width_px * self.grid.cells_per_px / 2
        x, y = self.centre
        upright = [
            (x - half_length, y - half_width),
            (x + half_length, y - half_width),
            (x + half_length, y + half_width),
            (x - half_length, y + half_width),
        ]
        return self._to_image(np.array(upright))

    @property
    def centre_in_image(self) -> tuple[float, float]:
        """Its centre in pixels of the image."""
        places = self._to_image(np.array([self.centre]))
        x, y = places[0].tolist()
        return x, y

    @property
    def heading_deg(self) -> float:
        """Direction of its length in the image, clockwise from up, 0 to 180."""
        start, end, _, _ = self.corners(self.length_px, self.width_px).tolist()
        across = end[0] - start[0]
        down = end[1] - start[1]
        return math.degrees(math.atan2(across, -down)) % 180

    def count_rows(self, length_px: float, width_px: float) -> int:
        """Count rectangles of another size that fit beside each other, in rows at this heading.

        More may fit at other headings, so the number is a lower bound.
        """
        length, width = _whole_cells(
            length_px * self.grid.cells_per_px, width_px * self.grid.cells_per_px
        )
        free = _free_places(_integral(self.turned), length, width)
        if free is None or not free.any():
            return 0
        return _most_in_rows(free, length, width)

    def _to_image(self, points: Corners) -> Corners:
        return _mapped(self.grid.to_image @ self.to_grid, points)


def make_grid(
    pixels: ObjectMask, parts: Sequence[Part] = (), plane: GroundPlane | None = None
) -> Grid:
    """Make the cells of an object.

    Args:
        pixels: its mask.
        parts: rings of a polygon in pixels of the image; empty for a mask.
        plane: ground plane of a tilted camera; None at nadir.
    """
    if parts:
        return _grid_of_polygon(parts, plane)
    if plane is None:
        return _grid_of_mask(pixels)
    return _grid_on_ground(pixels, plane)


def _grid_of_polygon(parts: Sequence[Part], plane: GroundPlane | None) -> Grid:
    on_ground = parts
    if plane is not None:
        on_ground = [[plane.from_above(ring) for ring in part] for part in parts]
    bounds = bounds_of(on_ground)
    left, top, right, bottom = bounds
    fine = finer_cells(bounds, side_px=_SIDE_CELLS, most=_MOST_CELLS_PER_PX)
    # The cells of a large polygon are coarser than pixels.
    coarse = math.ceil(max(right - left, bottom - top) / _SIDE_CELLS)
    cells_per_px = float(fine)
    if fine == 1 and coarse > 1:
        cells_per_px = 1 / coarse
    scaled = []
    for part in on_ground:
        scaled.append([(ring - (left, top)) * cells_per_px for ring in part])
    cells = mask_of(scaled, bounds_of(scaled))
    offset_x, offset_y, _, _ = bounds_of(scaled)
    to_px = _scale_and_shift(
        1 / cells_per_px, left + offset_x / cells_per_px, top + offset_y / cells_per_px
    )
    if plane is not None:
        corners = np.concatenate([part[0] for part in parts])
        to_px = _from_ground(corners, plane) @ to_px
    return Grid(cells, to_px, cells_per_px)


def _grid_of_mask(pixels: ObjectMask) -> Grid:
    mask = pixels.mask
    left = pixels.window.x_px
    top = pixels.window.y_px
    rows = np.flatnonzero(mask.any(axis=1))
    columns = np.flatnonzero(mask.any(axis=0))
    filled_rows = slice(rows[0], rows[-1] + 1)
    filled_columns = slice(columns[0], columns[-1] + 1)
    mask = mask[filled_rows, filled_columns]
    left += int(columns[0])
    top += int(rows[0])
    longer = max(mask.shape)
    if longer <= _SIDE_CELLS:
        fine = min(_MOST_CELLS_PER_PX, _SIDE_CELLS // longer)
        # The steps of a slanted edge belong to the pixels, not to the object, so they are smoothed.
        opaque = np.pad(mask.view(np.uint8) * 255, 1)
        smooth = cv2.resize(opaque, None, fx=fine, fy=fine, interpolation=cv2.INTER_LINEAR)
        cells = np.asarray(smooth > _HALF_OPAQUE)
        return Grid(cells, _scale_and_shift(1 / fine, left - 1, top - 1), float(fine))
    coarse = math.ceil(longer / _SIDE_CELLS)
    height, width = mask.shape
    bottom = -height % coarse
    right = -width % coarse
    padded = np.pad(mask, ((0, bottom), (0, right)))
    # A coarse cell is inside if all its pixels are.
    blocks = padded.reshape(padded.shape[0] // coarse, coarse, -1, coarse)
    cells = np.asarray(blocks.all(axis=(1, 3)))
    return Grid(cells, _scale_and_shift(coarse, left, top), 1 / coarse)


def _grid_on_ground(pixels: ObjectMask, plane: GroundPlane) -> Grid:
    """Rectify a mask to the ground."""
    window = pixels.window
    right = window.x_px + window.width_px
    bottom = window.y_px + window.height_px
    corners = np.array(
        [
            (window.x_px, window.y_px),
            (right, window.y_px),
            (right, bottom),
            (window.x_px, bottom),
        ],
        dtype=np.float64,
    )
    ground = plane.from_above(corners)
    low = ground.min(axis=0)
    sides = ground.max(axis=0) - low
    cells_per_px = min(float(_MOST_CELLS_PER_PX), _SIDE_CELLS / float(sides.max()))
    to_ground = _scale_and_shift(1 / cells_per_px, *low.tolist())
    to_image = _from_ground(corners, plane) @ to_ground
    width, height = np.ceil(sides * cells_per_px).astype(int).tolist()
    to_window = _scale_and_shift(1.0, -window.x_px, -window.y_px) @ to_image
    cells = _warped(pixels.mask, to_window, width, height)
    return Grid(cells, to_image, cells_per_px)


def _from_ground(corners: Corners, plane: GroundPlane) -> Matrix:
    """Compute the map from the rectified ground to the image, which is projective."""
    left, top = corners.min(axis=0)
    right, bottom = corners.max(axis=0)
    x = [left, right, right, left]
    y = [top, top, bottom, bottom]
    box = np.column_stack([x, y])
    ground = plane.from_above(box)
    matrix = cv2.getPerspectiveTransform(ground.astype(np.float32), box.astype(np.float32))
    return np.asarray(matrix, dtype=np.float64)


def place_circle(grid: Grid) -> PlacedCircle | None:
    """Find the largest circle; None in an empty mask."""
    circle = inscribed_circle(grid.cells)
    if circle is None:
        return None
    centre = np.array([[circle.x, circle.y]])
    x, y = _mapped(grid.to_image, centre)[0].tolist()
    return PlacedCircle((x, y), circle.diameter / grid.cells_per_px)


def place_rectangle(grid: Grid, length: float, width: float) -> PlacedRectangle | None:
    """Find the largest rectangle with the proportions ``length`` to ``width``; None without one."""
    search = _Search(grid.cells, length, width)
    # The sides of the mask first: a large rectangle early makes the other headings quick.
    for heading in _side_headings(grid.cells):
        search.try_heading(heading)
    for step in range(_N_HEADINGS):
        search.try_heading(step * _HEADING_STEP_DEG)
    for share in _REFINEMENTS:
        middle = search.heading_deg
        for offset in (-share, share):
            search.try_heading(middle + offset * _HEADING_STEP_DEG)
    if search.best is None:
        return None
    turned, to_grid, centre = search.best
    return PlacedRectangle(
        grid,
        to_grid,
        turned,
        centre,
        length_px=search.cells_per_unit * length / grid.cells_per_px,
        width_px=search.cells_per_unit * width / grid.cells_per_px,
    )


class _Search:
    """Search for the largest rectangle over headings.

    Attributes:
        cells_per_unit: size of the largest one so far: cells per unit of length and width.
        heading_deg: the heading of the largest one so far.
        best: its turned cells, their map to the grid, and its centre in them; None before.
    """

    def __init__(self, cells: Mask, length: float, width: float) -> None:
        self._cells = cells
        self._length = length
        self._width = width
        self._largest = math.sqrt(cells.sum() / (length * width))
        # A rectangle of fewer cells than one is none.
        self.cells_per_unit = 0.0
        self.heading_deg = 0.0
        self.best: tuple[Mask, Matrix, tuple[float, float]] | None = None

    def try_heading(self, heading_deg: float) -> None:
        """Try one heading, and keep its largest rectangle if it is larger than that of others."""
        turned, to_grid = _turned(self._cells, heading_deg)
        integral = _integral(turned)
        low = max(self.cells_per_unit * _LEAST_GAIN, 1 / self._length)
        high = self._largest
        places = self._places(integral, low)
        if low >= high or places is None:
            return
        for _ in range(_N_HALVINGS):
            middle = (low + high) / 2
            more = self._places(integral, middle)
            if more is None:
                high = middle
            else:
                low = middle
                places = more
        self.cells_per_unit = low
        self.heading_deg = heading_deg
        self.best = (turned, to_grid, self._middle_place(places, low))

    def _places(self, integral: NDArray[np.int32], cells_per_unit: float) -> Mask | None:
        """Find the places of a size; None without any."""
        length, width = _whole_cells(self._length * cells_per_unit, self._width * cells_per_unit)
        free = _free_places(integral, length, width)
        if free is None or not free.any():
            return None
        return free

    def _middle_place(self, places: Mask, cells_per_unit: float) -> tuple[float, float]:
        """Return the centre of the rectangle whose place is nearest to the middle of all places."""
        length, width = _whole_cells(self._length * cells_per_unit, self._width * cells_per_unit)
        rows, columns = np.nonzero(places)
        squares = (rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2
        nearest = int(np.argmin(squares))
        x = float(columns[nearest]) + length / 2
        y = float(rows[nearest]) + width / 2
        return x, y


def _side_headings(cells: Mask) -> tuple[float, float]:
    """Return both directions of the smallest rotated rectangle around a mask, degrees."""
    points = cv2.findNonZero(cells.view(np.uint8))
    if points is None:
        return 0.0, 90.0
    _, _, angle_deg = cv2.minAreaRect(points)
    return float(angle_deg), float(angle_deg) + 90


def _whole_cells(length: float, width: float) -> tuple[int, int]:
    """Round up to whole cells, so that no rectangle is wider than the mask."""
    whole_length = max(1, math.ceil(length - _ROUNDING))
    whole_width = max(1, math.ceil(width - _ROUNDING))
    return whole_length, whole_width


def _turned(cells: Mask, heading_deg: float) -> tuple[Mask, Matrix]:
    """Turn cells so that rectangles of a heading are upright.

    Returns:
        The turned cells, and the map from them to the cells.
    """
    height, width = cells.shape
    # OpenCV maps centres of cells: the first cell is at 0, 0.
    centre = ((width - 1) / 2, (height - 1) / 2)
    matrix = cv2.getRotationMatrix2D(centre, heading_deg, 1.0)
    heading = math.radians(heading_deg)
    cosine = abs(math.cos(heading))
    sine = abs(math.sin(heading))
    turned_width = math.ceil(width * cosine + height * sine) + 2
    turned_height = math.ceil(width * sine + height * cosine) + 2
    matrix[0, 2] += (turned_width - width) / 2
    matrix[1, 2] += (turned_height - height) / 2
    size = (turned_width, turned_height)
    opaque = cells.view(np.uint8) * 255
    # Between cells: half of a cell at the edge is inside.
    blurred = cv2.warpAffine(opaque, matrix, size, flags=cv2.INTER_LINEAR)
    turned = np.asarray(blurred > _HALF_OPAQUE)
    forward = np.vstack([matrix, (0.0, 0.0, 1.0)])
    half = _scale_and_shift(1.0, 0.5, 0.5)
    back = half @ np.linalg.inv(forward) @ np.linalg.inv(half)
    return turned, back


def _warped(mask: Mask, to_mask: Matrix, width: int, height: int) -> Mask:
    """Sample a mask at the centres of other cells.

    Args:
        mask: the mask.
        to_mask: map from the cells to pixels of the mask.
        width: columns of the result.
        height: rows of the result.
    """
    half = _scale_and_shift(1.0, 0.5, 0.5)
    between_centres = np.linalg.inv(half) @ to_mask @ half
    warped = cv2.warpPerspective(
        mask.view(np.uint8) * 255,
        between_centres,
        (width, height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
    )
    return np.asarray(warped > _HALF_OPAQUE)


def _integral(cells: Mask) -> NDArray[np.int32]:
    """Sum the cells above and to the left of each corner, ``[h + 1, w + 1]``."""
    return np.asarray(cv2.integral(cells.view(np.uint8)), dtype=np.int32)


def _free_places(integral: NDArray[np.int32], length: int, width: int) -> Mask | None:
    """Find the first cells of all upright rectangles inside the mask; None if it is too small."""
    n_rows, n_columns = integral.shape
    if width >= n_rows or length >= n_columns:
        return None
    below = integral[width:]
    above = integral[:-width]
    between = below - above
    sums = between[:, length:] - between[:, :-length]
    return np.asarray(sums == length * width)


def _most_in_rows(free: Mask, length: int, width: int) -> int:
    """Count the rectangles of the best choice of rows.

    Args:
        free: ``[n, m]`` places of the first cell of a rectangle.
        length: cells along a row.
        width: cells from a row to the next one.
    """
    n_rows = len(free)
    # The most from each row on: the row is left out, or filled, and the next begins below it.
    most = np.zeros(n_rows + width, dtype=int)
    for row in range(n_rows - 1, -1, -1):
        without_row = most[row + 1]
        with_row = _fill_row(free[row], length) + most[row + width]
        most[row] = max(without_row, with_row)
    return int(most[0])


def _fill_row(free: Mask, length: int) -> int:
    """Count the rectangles in a row, filled from its start."""
    padded = np.concatenate([[False], free, [False]])
    starts_and_stops = np.flatnonzero(padded[1:] != padded[:-1]).tolist()
    n_placed = 0
    next_free = 0
    starts = starts_and_stops[::2]
    stops = starts_and_stops[1::2]
    # Each run of free places takes one rectangle, and one more for each further length.
    for start, stop in zip(starts, stops, strict=True):
        first = max(start, next_free)
        if first >= stop:
            continue
        n_in_run = (stop - 1 - first) // length + 1
        n_placed += n_in_run
        next_free = first + n_in_run * length
    return n_placed


def _scale_and_shift(scale: float, x: float, y: float) -> Matrix:
    return np.array([(scale, 0.0, x), (0.0, scale, y), (0.0, 0.0, 1.0)])


def _mapped(matrix: Matrix, points: Corners) -> Corners:
    """Map points ``[n, 2]``."""
    ones = np.ones((len(points), 1))
    mapped = np.hstack([points, ones]) @ matrix.T
    return np.asarray(mapped[:, :2] / mapped[:, 2:])
