"""Insets: pictures that were put over a part of another one.

The border of an inset is a rectangle along rows and columns, exact to a pixel, and abrupt: the step
across it exceeds the steps beside it, because the pixels on both sides are unrelated. A camera
blurs the edge of a roof or road over several pixels, and such edges hardly form whole rectangles.
Some insets have a frame instead: a thin line of one colour that differs from both sides.

The search takes the columns and rows with the longest abrupt borders, and compares the rectangles
between them. Sides at the border of the image are not seen and do not count. Resized or compressed
borders are weaker, and a rectangle suffices that two of three maps show: steps, steps over two
pixels, and lines. The map of steps must then show an inset that is brighter here and darker there:
a roof is brighter or darker than all of its surroundings.
"""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from vehanchor.imagery.texture import MIN_COMMON_TEXTURE, common_texture

if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import TypeAlias

    from numpy.typing import NDArray

    Grey: TypeAlias = NDArray[np.uint8]
    """``[h, w]`` grey values."""

    Strengths: TypeAlias = NDArray[np.float32]
    """``[h, w]`` -0.5 to 1, how clearly each pixel lies on a border along its column."""

    PerRectangle: TypeAlias = NDArray[np.float64]
    """``[n]`` one number for each rectangle."""

    Places: TypeAlias = NDArray[np.intp]
    """``[n]``, or one row for each side, rows or columns."""

# Numbers without a measurement beside them are choices.

# Least strengths of a rectangle whose borders are steps, and lines. The formula was chosen on 300
# insets and the usable photographs; ``research/results/notes.md`` has the shares that are found.
_LEAST_OF_STEPS = 0.61
_LEAST_OF_LINES = 0.96
# Least sum of the strengths of a border in two maps, to which a border adds that is brighter here
# and darker there; and of lines without that. Kerbs and lanes have lines up to 1.3.
_LEAST_OF_AGREEING = 1.9
_LEAST_OF_AGREEING_LINES = 1.5
_ALTERNATING = 4.64
_MAX_ALTERNATING = 0.2
_MIN_DIFFERENCE = 2.0
# Least mean difference of grey values across each side of such a border: 21 insets have 14 and
# more, a part of a roof that was taken for one 11.
_MIN_MEAN_DIFFERENCE = 12.0
# Least overlap (intersection over union) of one rectangle in two maps, and its least strength.
_SAME_RECTANGLE = 0.85
_MIN_AGREEING = 0.15
# Rectangles of a map that are compared, and by how many pixels they differ at least.
_N_RECTANGLES = 2
_DISTINCT_PX = 4
# Weights of the weakest side, of a border that goes on beyond a corner, and of the log length.
_WEAKEST = 0.3
_GOING_ON = 0.4
_LENGTH = 0.2
_USUAL_LENGTH_PX = 150
# Grey levels that are added to a step before it is compared with its neighbours.
_STEP_LEVELS = 4.0
_LINE_LEVELS = 8.0
_LEAST_STRENGTH = -0.5
# Columns from a step over two pixels to those with which it is compared.
_WIDE_REACH_PX = 3
# Pixels from the middle of a line to both sides, and along it to where it has the same colour.
_LINE_REACH_PX = 3
_ALONG_PX = (2, 5)
# Columns and rows that bound rectangles, and the share of the shorter side over which the
# border of a candidate is averaged.
_MAX_LINES = 9
_LINE_SHARE = 0.18
_MIN_LINE_PX = 24
_MIN_LINE_STRENGTH = -0.02
_MARGIN_PX = 6
_SPACING_PX = 2
# Least side over the shorter side of the image, its least in pixels, and the largest area over that
# of the image. Larger pictures meet in a seam across the image.
_MIN_SIDE_SHARE = 0.15
_MIN_SIDE_PX = 20
_MAX_AREA_SHARE = 0.62
# Pixels beyond a corner in which a border that ends there does not go on.
_BEYOND_SHARE = 0.08
_MIN_BEYOND_PX = 12
_CORNER_PX = 2
_MIN_SEEN_PX = 6
# JPEG divides the picture into blocks of 8 px; borders of one phase that stand out are blocks.
_BLOCK_PX = 8
_BLOCKY = 0.06
_NEIGHBOURS = np.array([[1, 1, 0, 1, 1]], np.uint8)
# Plain ground, on which a drawing shows things: grey levels by which it varies, its share of the
# image, and of what surrounds the rectangle at some distance.
_GROUND_LEVELS = 3
_MAX_GROUND = 0.10
_GROUND_AROUND = 0.7
_AROUND_PX = 3
# Pixels from the middle of a border to those that are compared across it, and their number.
_BESIDE_PX = 3
_COMPARED_PX = 2
# Spread of grey values up to which a border or a rectangle is plain.
_PLAIN_SD = 4.0


class Inset(NamedTuple):
    """Rectangle of an inset, in pixels.

    Attributes:
        left: its first column; 0 if it reaches the border of the image.
        top: its first row.
        right: the column behind its last one.
        bottom: the row behind its last one.
        strength: how clear its border is.
    """

    left: int
    top: int
    right: int
    bottom: int
    strength: float

    @property
    def area(self) -> int:
        """Pixels of the rectangle."""
        return (self.right - self.left) * (self.bottom - self.top)

    @property
    def corner(self) -> tuple[int, int]:
        """Column and row of a corner inside the image."""
        return (self.left or self.right, self.top or self.bottom)


def find_inset(grey: Grey, *, with_frames: bool = True) -> Inset | None:
    """Find an inset in an image.

    Args:
        grey: the image.
        with_frames: whether to look for frames of thin lines, and for weak borders, too.

    Returns:
        The clearest one; None without one.
    """
    transposed = np.ascontiguousarray(grey.T)
    of_columns = _without_blocks(_step_strengths(grey))
    of_rows = _without_blocks(_step_strengths(transposed))
    by_steps = _best_rectangles(of_columns, of_rows)
    for inset in by_steps:
        if inset.strength >= _LEAST_OF_STEPS and not _is_thing(grey, inset):
            return inset
    if not with_frames:
        return None
    by_lines = _best_rectangles(_line_strengths(grey), _line_strengths(transposed))
    for inset in by_lines:
        # A line of the ground's colour separates things in a drawing.
        is_grid = _lies_on_ground(grey, inset, 0) or _goes_on_behind(grey, inset)
        if inset.strength >= _LEAST_OF_LINES and not is_grid:
            return inset
    # Most images have no rectangle that a third map could confirm.
    weak = [inset for inset in (*by_lines, *by_steps) if _may_be_weak(grey, inset)]
    if not weak:
        return None
    of_columns = _without_blocks(_wide_step_strengths(grey))
    of_rows = _without_blocks(_wide_step_strengths(transposed))
    return _agreed(grey, weak, by_lines, _best_rectangles(of_columns, of_rows))


def _may_be_weak(grey: Grey, inset: Inset) -> bool:
    """Test whether a rectangle is clear enough for an inset with a weak border."""
    return inset.strength >= _MIN_AGREEING and _differs(grey, inset)


def _agreed(
    grey: Grey, weak: list[Inset], by_lines: list[Inset], by_wide_steps: list[Inset]
) -> Inset | None:
    """Find an inset with a weak border that two maps show; None without one.

    Args:
        grey: the image.
        weak: rectangles whose borders are steps or lines, and may be weak.
        by_lines: rectangles whose borders are lines.
        by_wide_steps: rectangles whose borders are steps over two pixels.
    """
    for inset, wide in product(weak, by_wide_steps):
        if not _agree(inset, wide):
            continue
        if _is_thing(grey, inset) or _lies_on_ground(grey, inset, 0):
            continue
        strength = inset.strength + wide.strength
        if inset in by_lines and strength < _LEAST_OF_AGREEING_LINES:
            continue
        alternating = min(_alternating_share(grey, inset), _MAX_ALTERNATING)
        if strength + _ALTERNATING * alternating >= _LEAST_OF_AGREEING:
            return inset
    return None


def _agree(first: Inset, second: Inset) -> bool:
    """Test whether two maps show one rectangle."""
    if min(first.strength, second.strength) < _MIN_AGREEING:
        return False
    width = min(first.right, second.right) - max(first.left, second.left)
    height = min(first.bottom, second.bottom) - max(first.top, second.top)
    common = max(0, width) * max(0, height)
    return common > _SAME_RECTANGLE * (first.area + second.area - common)


def _is_thing(grey: Grey, inset: Inset) -> bool:
    """Test whether a rectangle is plain, lies on plain ground, or shows what is around it."""
    if _is_plain(grey, inset) or _lies_on_ground(grey, inset, _AROUND_PX):
        return True
    return _goes_on_behind(grey, inset)


def _step_strengths(grey: Grey) -> Strengths:
    """Compute how far the step from the column to the left exceeds its neighbours."""
    step = cv2.absdiff(grey[:, :-1], grey[:, 1:])
    neighbour = cv2.dilate(step, _NEIGHBOURS)
    strengths = np.zeros(grey.shape, np.float32)
    strengths[:, 1:] = _contrast(_grey(step), _grey(neighbour), _STEP_LEVELS)
    return strengths


def _wide_step_strengths(grey: Grey) -> Strengths:
    """Compute how far the step over two pixels exceeds those three columns beside it."""
    reach = _WIDE_REACH_PX
    step = cv2.absdiff(grey[:, :-2], grey[:, 2:])
    strengths = np.zeros(grey.shape, np.float32)
    if step.shape[1] <= 2 * reach:
        return strengths
    beside = cv2.max(step[:, : -2 * reach], step[:, 2 * reach :])
    middle = np.ascontiguousarray(step[:, reach:-reach])
    # The step of a column is from the one to its left to the one to its right.
    first = reach + 1
    contrast = _contrast(_grey(middle), _grey(beside), _STEP_LEVELS)
    strengths[:, first : first + contrast.shape[1]] = contrast
    return strengths


def _line_strengths(grey: Grey) -> Strengths:
    """Compute how far a column differs from both sides, less how far it varies along itself."""
    reach = _LINE_REACH_PX
    middle = np.ascontiguousarray(grey[:, reach:-reach])
    left = cv2.absdiff(middle, grey[:, : -2 * reach])
    right = cv2.absdiff(middle, grey[:, 2 * reach :])
    across = cv2.min(left, right)
    along = np.zeros_like(across)
    for distance in _ALONG_PX:
        variation = cv2.absdiff(middle[2 * distance :], middle[: -2 * distance])
        inner = along[distance:-distance]
        np.maximum(inner, variation, out=inner)
    strengths = np.zeros(grey.shape, np.float32)
    strengths[:, reach:-reach] = _contrast(_grey(across), _grey(along), _LINE_LEVELS)
    return strengths


def _grey(image: cv2.typing.MatLike) -> Grey:
    return np.asarray(image, np.uint8)


def _contrast(signal: Grey, noise: Grey, levels: float) -> Strengths:
    """Divide the difference of two grey values by their sum, from -0.5 on."""
    contrast = np.asarray(cv2.subtract(signal, noise, dtype=cv2.CV_32F), np.float32)
    total = np.asarray(cv2.add(signal, noise, dtype=cv2.CV_32F), np.float32)
    total += np.float32(levels)
    contrast /= total
    return np.maximum(contrast, np.float32(_LEAST_STRENGTH), out=contrast)


def _is_plain(grey: Grey, inset: Inset) -> bool:
    """Test whether a rectangle has one colour, as a painted court, a pool or a roof."""
    inside = grey[inset.top : inset.bottom, inset.left : inset.right]
    return float(inside[_BESIDE_PX:-_BESIDE_PX, _BESIDE_PX:-_BESIDE_PX].std()) <= _PLAIN_SD


def _lies_on_ground(grey: Grey, inset: Inset, distance_px: int) -> bool:
    """Test whether a rectangle is surrounded by one colour that much of the image has.

    Args:
        grey: the image.
        inset: the rectangle.
        distance_px: pixels from its border to what surrounds it.
    """
    height, width = grey.shape
    rows = slice(inset.top, inset.bottom)
    columns = slice(inset.left, inset.right)
    left = inset.left - distance_px
    right = inset.right + distance_px
    top = inset.top - distance_px
    bottom = inset.bottom + distance_px
    around = []
    if inset.left > 0 and left >= 0:
        around.append(grey[rows, left])
    if right < width:
        around.append(grey[rows, right])
    if inset.top > 0 and top >= 0:
        around.append(grey[top, columns])
    if bottom < height:
        around.append(grey[bottom, columns])
    if not around:
        return False
    surroundings = np.concatenate(around)
    colour = float(np.median(surroundings))
    share_around = (np.abs(surroundings - colour) <= _GROUND_LEVELS).mean()
    share = (np.abs(grey - colour) <= _GROUND_LEVELS).mean()
    return bool(share_around >= _GROUND_AROUND and share > _MAX_GROUND)


def _goes_on_behind(grey: Grey, inset: Inset) -> bool:
    """Test whether one picture goes on behind the border, as behind the lines of a map's grid."""
    common = []
    for left, right in _both_sides(grey, inset):
        left_spread = left.std(axis=0).max()
        right_spread = right.std(axis=0).max()
        # A thick frame has no texture that could go on.
        if min(left_spread, right_spread) > _PLAIN_SD:
            common.append(common_texture(left, right))
    return bool(common) and float(np.median(common)) >= MIN_COMMON_TEXTURE


def _differs(grey: Grey, inset: Inset) -> bool:
    """Test whether the picture differs across each side: a part of a roof has the roof's colour."""
    for left, right in _both_sides(grey, inset):
        difference = right.mean(axis=1) - left.mean(axis=1)
        if np.abs(difference).mean() < _MIN_MEAN_DIFFERENCE:
            return False
    return True


def _alternating_share(grey: Grey, inset: Inset) -> float:
    """Compute the share of the border, 0 to 0.5, at which the usually darker side is brighter."""
    shares = []
    lengths = []
    for left, right in _both_sides(grey, inset):
        difference = right.mean(axis=1) - left.mean(axis=1)
        brighter = float((difference > _MIN_DIFFERENCE).mean())
        darker = float((difference < -_MIN_DIFFERENCE).mean())
        shares.append(min(brighter, darker))
        lengths.append(len(difference))
    return float(np.average(shares, weights=lengths)) if shares else 0.0


def _both_sides(grey: Grey, inset: Inset) -> Iterator[tuple[Grey, Grey]]:
    """Cut out the pixels on both sides of each side of a rectangle, as columns ``[n, 2]``."""
    transposed = np.ascontiguousarray(grey.T)
    rows = slice(inset.top, inset.bottom)
    columns = slice(inset.left, inset.right)
    sides = (
        (grey[rows], inset.left),
        (grey[rows], inset.right),
        (transposed[columns], inset.top),
        (transposed[columns], inset.bottom),
    )
    for along, place in sides:
        first = place - _BESIDE_PX - _COMPARED_PX
        behind = place + _BESIDE_PX
        if first < 0 or behind + _COMPARED_PX > along.shape[1]:
            continue
        left = along[:, first : first + _COMPARED_PX]
        yield left, along[:, behind : behind + _COMPARED_PX]


def _without_blocks(strengths: Strengths) -> Strengths:
    """Set the borders of visible blocks of a compressed image to zero."""
    mean = strengths.mean(axis=0)
    phases = range(_BLOCK_PX)
    usual = np.array([np.median(mean[phase::_BLOCK_PX]) for phase in phases])
    surplus = usual - np.median(usual)
    for phase in np.flatnonzero(surplus > _BLOCKY):
        strengths[:, phase::_BLOCK_PX] = 0.0
    return strengths


def _candidates(strengths: Strengths, length_px: int) -> list[int]:
    """Select the columns with the clearest borders of some length."""
    pieces = cv2.blur(strengths, (1, length_px), borderType=cv2.BORDER_CONSTANT)
    best = pieces.max(axis=0)
    n_columns = len(best)
    best[:_MARGIN_PX] = _LEAST_STRENGTH
    best[n_columns - _MARGIN_PX :] = _LEAST_STRENGTH
    columns: list[int] = []
    while len(columns) < _MAX_LINES:
        column = int(best.argmax())
        if best[column] < _MIN_LINE_STRENGTH:
            break
        columns.append(column)
        best[max(0, column - _SPACING_PX) : column + _SPACING_PX + 1] = _LEAST_STRENGTH
    return sorted(columns)


def _best_rectangles(of_columns: Strengths, of_rows: Strengths) -> list[Inset]:
    """Find the rectangles with the clearest borders.

    Args:
        of_columns: ``[h, w]`` strengths of borders along columns.
        of_rows: ``[w, h]`` strengths of borders along rows.

    Returns:
        The clearest first; none without candidates.
    """
    height, width = of_columns.shape
    side = min(height, width)
    if side < 2 * max(_MIN_SIDE_PX, _MARGIN_PX):
        return []
    length_px = max(_MIN_LINE_PX, round(_LINE_SHARE * side))
    x_px = np.array([0, *_candidates(of_columns, length_px), width])
    y_px = np.array([0, *_candidates(of_rows, length_px), height])
    # All rectangles between the candidates: a row each of left, right, top and bottom.
    grids = np.meshgrid(x_px[:-1], x_px[1:], y_px[:-1], y_px[1:])
    rectangles = np.stack([grid.ravel() for grid in grids])
    is_inset = _may_be_insets(rectangles, width, height)
    if not is_inset.any():
        return []
    left, right, top, bottom = rectangles[:, is_inset]
    beyond_px = max(_MIN_BEYOND_PX, round(_BEYOND_SHARE * side))
    column_sums = _Sums.of(of_columns, x_px, beyond_px)
    row_sums = _Sums.of(of_rows, y_px, beyond_px)
    sides = (
        column_sums.side(left, top, bottom),
        column_sums.side(right, top, bottom),
        row_sums.side(top, left, right),
        row_sums.side(bottom, left, right),
    )
    strengths = _strengths_of(sides)
    corners = np.stack([left, top, right, bottom], axis=1)
    chosen: list[int] = []
    for k in np.argsort(-strengths).tolist():
        differences = np.abs(corners[chosen] - corners[k]).max(axis=1)
        if (differences > _DISTINCT_PX).all():
            chosen.append(k)
        if len(chosen) == _N_RECTANGLES:
            break
    return [
        Inset(
            int(left[k]),
            int(top[k]),
            right=int(right[k]),
            bottom=int(bottom[k]),
            strength=float(strengths[k]),
        )
        for k in chosen
    ]


def _may_be_insets(rectangles: Places, width: int, height: int) -> NDArray[np.bool_]:
    """Test which rectangles ``[n]`` have the size of an inset.

    Args:
        rectangles: ``[4, n]`` left, right, top and bottom.
        width: columns of the image.
        height: rows of the image.
    """
    left, right, top, bottom = rectangles
    columns = right - left
    rows = bottom - top
    least_px = max(_MIN_SIDE_PX, _MIN_SIDE_SHARE * min(height, width))
    is_large = (columns >= least_px) & (rows >= least_px)
    is_part = (columns < width) & (rows < height)
    is_small = columns * rows <= _MAX_AREA_SHARE * width * height
    return np.asarray(is_large & is_part & is_small)


class _Sides(NamedTuple):
    """One side of each rectangle.

    Attributes:
        mean: strength; not a number for a side at the border of the image.
        length: pixels; 0 for a side at the border of the image.
        beyond: the larger strength of the same column or row beyond both corners.
    """

    mean: PerRectangle
    length: PerRectangle
    beyond: PerRectangle


class _Sums(NamedTuple):
    """Sums of strengths along those columns that bound rectangles.

    Attributes:
        columns: ``[n]`` rising; the first and the last one are the borders of the image.
        sums: ``[h + 1, n]`` sums over the rows above.
        beyond_px: pixels beyond a corner that are looked at.
    """

    columns: Places
    sums: NDArray[np.float64]
    beyond_px: int

    @classmethod
    def of(cls, strengths: Strengths, columns: Places, beyond_px: int) -> _Sums:
        """Sum strengths along columns."""
        sums = np.zeros((len(strengths) + 1, len(columns)))
        np.cumsum(strengths[:, columns[:-1]], axis=0, out=sums[1:, :-1])
        return cls(columns, sums, beyond_px)

    def side(self, columns: Places, first: Places, behind: Places) -> _Sides:
        """Measure one side of each rectangle.

        Args:
            columns: its column.
            first: its first row.
            behind: the row behind its last one.
        """
        places = np.searchsorted(self.columns, columns)
        is_seen = (places > 0) & (places < len(self.columns) - 1)
        mean, length = self._mean(places, first, behind)
        before = self._mean(places, first - self.beyond_px, first - _CORNER_PX)
        after = self._mean(places, behind + _CORNER_PX, behind + self.beyond_px)
        beyond = np.zeros(len(columns))
        for part_mean, part_length in (before, after):
            goes_on = np.where(is_seen & (part_length >= _MIN_SEEN_PX), part_mean, 0.0)
            beyond = np.maximum(beyond, goes_on)
        seen_mean = np.where(is_seen, mean, np.nan)
        seen_length = np.where(is_seen, length, 0.0)
        return _Sides(seen_mean, seen_length, beyond)

    def _mean(
        self, places: Places, first: Places, behind: Places
    ) -> tuple[PerRectangle, PerRectangle]:
        """Average strengths over rows inside the image, and count these rows."""
        last = len(self.sums) - 1
        start = np.clip(first, 0, last)
        end = np.clip(behind, 0, last)
        length = np.maximum(end - start, 0).astype(np.float64)
        total = self.sums[end, places] - self.sums[start, places]
        return total / np.maximum(length, 1.0), length


def _strengths_of(sides: tuple[_Sides, ...]) -> PerRectangle:
    """Combine the sides of each rectangle to its strength."""
    means = np.stack([side.mean for side in sides])
    lengths = np.stack([side.length for side in sides])
    beyond = np.stack([side.beyond for side in sides]).max(axis=0)
    length = lengths.sum(axis=0)
    mean = (np.nan_to_num(means) * lengths).sum(axis=0) / length
    weakest = np.nanmin(means, axis=0)
    by_length = _LENGTH * np.log(length / _USUAL_LENGTH_PX)
    return np.asarray(mean + _WEAKEST * weakest - _GOING_ON * beyond + by_length)
