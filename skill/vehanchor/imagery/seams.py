"""Seams of a composed image: pictures side by side, collages and insets.

Where two pictures meet, the grey values change abruptly along a straight line, brighter here and
darker there, and the pixels on both sides are unrelated. The edge of a road or roof is straight,
too, but there one side is brighter along the whole line, or both sides share shadows and texture.

The search takes columns and rows, because programs compose pictures along them. Seams of pictures
that differ in brightness everywhere are not found, unless they are borders of an inset
(``vehanchor.imagery.insets``).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from vehanchor.imagery.insets import find_inset
from vehanchor.imagery.raster import Window
from vehanchor.imagery.texture import MIN_COMMON_TEXTURE, common_texture
from vehanchor.imagery.tiles import read_small_grey

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster

    Grey: TypeAlias = NDArray[np.uint8]
    """``[h, w]`` grey values."""

    Shares: TypeAlias = NDArray[np.float32]
    """``[h, w]`` 1 for a step, else 0; or the share of steps in a part of a column."""

    Line: TypeAlias = NDArray[np.float32]
    """``[n]`` a number for each pixel of a line, or for each line."""

# Numbers without a measurement beside them are choices.

# Longest side of the reduced image that is searched. A choice.
_SIDE_PX = 1024
# A side must have this many pixels after constant margins are cut off.
_MIN_SIDE_PX = 40
# Spread of grey values up to which a row or column at the border is a margin.
_MARGIN_SD = 4.0
# A step of this size is a part of a seam if it exceeds the three on either side.
_MIN_STEP = 3
_NEIGHBOURS = np.array([[1, 1, 1, 0, 1, 1, 1]], np.uint8)
# Share of the side near the border in which a line separates no picture.
_BORDER_SHARE = 0.10
_MIN_BORDER_PX = 11
# Seams across the image. Share of the line with steps, less what both sides have in common; and the
# share in which the darker side changes. Measured with all limits of this module: none of 1,061
# photographs that would be usable and right has a seam, and 76 of 80 collages of their parts that
# fill whole rows or columns. The limits were chosen on such photographs.
_MIN_SEAM = 0.60
_MIN_ALTERNATING = 0.08
_N_CANDIDATES = 4
# Columns of both sides that are compared: their first ones from the seam, and their number. The log
# ratio of the differences across and beside it exceeds the correlation of both sides by 0.07 and
# more in 56 collages of two scales, and in neither of two roads that were taken for seams.
_COMPARED_FROM_PX = (-11, -5, 2, 8)
_COMPARED_PX = 3
# Seams of an image at most: a contact sheet of seven columns has six strips with two edges each.
_MAX_SEAMS = 12
# A plain strip between pictures: the spread of its columns, and the share of its edges with steps.
_STRIP_SD = 2.0
_MIN_STRIP_EDGE = 0.7
# Share of the pictures that may have the strip's colour.
_MAX_SAME_COLOUR = 0.10
# JPEG divides the picture into blocks of 8 px, whose borders are steps in strongly compressed ones.
_BLOCK_PX = 8
_MIN_OVER_BLOCKS = 2.5


class Seam(NamedTuple):
    """Seam between two pictures.

    Attributes:
        x_px: column of a vertical seam, or of an inset's corner; None for a horizontal seam.
        y_px: row of a horizontal seam, or of an inset's corner; None for a vertical seam.
        inset: rectangle of an inset; None for a seam across the image.
    """

    x_px: int | None
    y_px: int | None
    inset: Window | None = None

    def moved(self, right_px: int, down_px: int) -> Seam:
        """Move the seam of a part of an image to its place in the image."""
        return _in_image(self, 1, right_px, down_px)


def find_seam(raster: Raster) -> Seam | None:
    """Find a seam in an image; None without one, and for an image too large to read for it."""
    small = read_small_grey(raster, _SIDE_PX)
    if small is None:
        return None
    grey, factor = small
    content, left, top = _without_margins(grey)
    if min(content.shape) < _MIN_SIDE_PX or _is_pixelated(_steps(content)):
        return None
    # A picture that was composed and then resized has blurred seams, sharp at half the size.
    half = cv2.resize(content, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    copies = ((content, 1), (np.asarray(half, np.uint8), 2))
    for copy, reduction in copies:
        seam = _seam(copy, with_frames=reduction == 1)
        if seam is not None:
            return _in_image(seam, factor * reduction, factor * left, factor * top)
    return None


def _seam(grey: Grey, *, with_frames: bool) -> Seam | None:
    """Find a seam across an image, or else a corner of an inset.

    Args:
        grey: the image.
        with_frames: as in ``vehanchor.imagery.insets.find_inset``.
    """
    transposed = np.ascontiguousarray(grey.T)
    of_columns = _steps(grey)
    column = _best_column(grey, of_columns)
    if column is not None:
        return Seam(column, None)
    of_rows = _steps(transposed)
    row = _best_column(transposed, of_rows)
    if row is not None:
        return Seam(None, row)
    inset = find_inset(grey, with_frames=with_frames)
    if inset is None:
        return None
    width = inset.right - inset.left
    height = inset.bottom - inset.top
    rectangle = Window(inset.left, inset.top, width_px=width, height_px=height)
    return Seam(*inset.corner, inset=rectangle)


def _in_image(seam: Seam, factor: int, left: int, top: int) -> Seam:
    """Convert a seam of a reduced part to pixels of the image."""
    x_px = None if seam.x_px is None else seam.x_px * factor + left
    y_px = None if seam.y_px is None else seam.y_px * factor + top
    inset = seam.inset
    if inset is not None:
        inset = Window(
            inset.x_px * factor + left,
            inset.y_px * factor + top,
            width_px=inset.width_px * factor,
            height_px=inset.height_px * factor,
        )
    return Seam(x_px, y_px, inset)


def _without_margins(grey: Grey) -> tuple[Grey, int, int]:
    """Cut constant rows and columns off the border.

    Returns:
        The rest, its first column and its first row; an empty array for a constant image.
    """
    rows = np.flatnonzero(grey.std(axis=1) > _MARGIN_SD)
    columns = np.flatnonzero(grey.std(axis=0) > _MARGIN_SD)
    if len(rows) == 0 or len(columns) == 0:
        return grey[:0, :0], 0, 0
    top = int(rows[0])
    left = int(columns[0])
    content = grey[top : rows[-1] + 1, left : columns[-1] + 1]
    return np.ascontiguousarray(content), left, top


class _Steps(NamedTuple):
    """Steps between a column and the one to its left that exceed their neighbours.

    Attributes:
        brighter: ``[h, w]`` 1 where the column is brighter, else 0.
        darker: ``[h, w]`` 1 where it is darker, else 0.
    """

    brighter: Shares
    darker: Shares


def _steps(grey: Grey) -> _Steps:
    """Find the steps between columns that exceed their neighbours."""
    left = grey[:, :-1]
    right = grey[:, 1:]
    size = cv2.absdiff(left, right)
    neighbours = cv2.dilate(size, _NEIGHBOURS)
    is_step = (size > neighbours) & (size >= _MIN_STEP)
    is_brighter = right > left
    brighter = np.zeros(grey.shape, np.float32)
    darker = np.zeros(grey.shape, np.float32)
    brighter[:, 1:] = is_step & is_brighter
    darker[:, 1:] = is_step & ~is_brighter
    return _Steps(brighter, darker)


def _is_pixelated(steps: _Steps) -> bool:
    """Test whether an image was enlarged without interpolation: its blocks have many seams."""
    share = (steps.brighter + steps.darker).mean(axis=0)
    return int((share >= _MIN_SEAM).sum()) > _MAX_SEAMS


def _best_column(grey: Grey, steps: _Steps) -> int | None:
    """Find the column at which a second picture begins; None without one."""
    brighter = steps.brighter.mean(axis=0)
    darker = steps.darker.mean(axis=0)
    share = brighter + darker
    strip = _strip_between(grey, share)
    if strip is not None:
        return strip
    share = _above_blocks(share)
    share[np.minimum(brighter, darker) < _MIN_ALTERNATING] = 0.0
    border = _border_px(len(share))
    share[:border] = 0.0
    share[len(share) - border :] = 0.0
    for column in np.argsort(-share)[:_N_CANDIDATES].tolist():
        if share[column] < _MIN_SEAM:
            return None
        unrelated = 1.0 - max(0.0, _common_texture(grey, column))
        if share[column] * unrelated >= _MIN_SEAM and _differ(grey, column):
            return int(column)
    return None


def _strip_between(grey: Grey, share: Line) -> int | None:
    """Find a strip of one colour that separates two pictures.

    Args:
        grey: ``[h, w]``.
        share: ``[w]`` share of each column with steps.

    Returns:
        Its first column; None without one.
    """
    is_plain = grey.std(axis=0) <= _STRIP_SD
    edges = np.diff(is_plain.astype(np.int8))
    first_columns = np.flatnonzero(edges > 0) + 1
    columns_behind = np.flatnonzero(edges < 0) + 1
    if is_plain[0]:
        columns_behind = columns_behind[1:]
    border = _border_px(len(share))
    # The last strip has no column behind it if it reaches the border.
    for first, behind in zip(first_columns.tolist(), columns_behind.tolist(), strict=False):
        # A bar near the border, as of a player, separates no picture.
        if behind <= border or first >= len(share) - border:
            continue
        # A compressed picture has pixels of both sides at its edge.
        near_first = share[max(0, first - 1) : first + 2].max()
        near_behind = share[behind - 1 : behind + 2].max()
        if min(near_first, near_behind) < _MIN_STRIP_EDGE:
            continue
        # The ground of a drawing is plain, too, but its colour is everywhere. So is paper between a
        # picture and its caption: between the letters, it goes on.
        colour = float(grey[:, first:behind].mean())
        has_colour = np.abs(grey - colour) <= _MARGIN_SD
        column_before = max(0, first - 2)
        column_behind = min(behind + 1, len(share) - 1)
        beside = has_colour[:, [column_before, column_behind]]
        if beside.mean(axis=0).max() > 1.0 - _MIN_STRIP_EDGE:
            continue
        if _goes_on_behind(grey, first, behind):
            continue
        if has_colour[:, ~is_plain].mean() <= _MAX_SAME_COLOUR:
            return int(first)
    return None


def _goes_on_behind(grey: Grey, first: int, behind: int) -> bool:
    """Test whether a picture goes on behind a strip: a line drawn over it, as of a map's grid.

    Args:
        grey: ``[h, w]``.
        first: first column of the strip.
        behind: first column behind it.
    """
    # The pixels next to the strip have its colour in them.
    left = grey[:, max(0, first - 3) : first - 1]
    right = grey[:, behind + 1 : behind + 3]
    if left.shape[1] == 0 or right.shape[1] == 0:
        return False
    return common_texture(left, right) >= MIN_COMMON_TEXTURE


def _above_blocks(share: Line) -> Line:
    """Set lines to zero that stand out no more than other borders of compressed blocks.

    Args:
        share: ``[w]`` share of each line with steps.
    """
    cleared = share.copy()
    for phase in range(_BLOCK_PX):
        of_phase = cleared[phase::_BLOCK_PX]
        usual = np.median(of_phase)
        of_phase[of_phase < _MIN_OVER_BLOCKS * usual] = 0.0
    return cleared


def _border_px(side_px: int) -> int:
    return max(_MIN_BORDER_PX, round(_BORDER_SHARE * side_px))


def _differ(grey: Grey, column: int) -> bool:
    """Test whether both sides of a column differ more than the ground on either side of it.

    Lanes and kerbs along a column are lines with steps, but beyond them the same road goes on, and
    the same shadows cross it.

    Args:
        grey: ``[h, w]``.
        column: at least eleven columns from the border.
    """
    means = []
    for first in _COMPARED_FROM_PX:
        compared = grey[:, column + first : column + first + _COMPARED_PX]
        means.append(compared.mean(axis=1, dtype=np.float32))
    far_left, left, right, far_right = means
    across = float(np.abs(right - left).mean())
    left_of_it = np.abs(left - far_left).mean()
    right_of_it = np.abs(right - far_right).mean()
    beside = float(left_of_it + right_of_it) / 2
    deviations_left = left - left.mean()
    deviations_right = right - right.mean()
    power_left = float((deviations_left**2).sum())
    power_right = float((deviations_right**2).sum())
    power = power_left * power_right
    correlation = 0.0
    if power > 0.0:
        correlation = float((deviations_left * deviations_right).sum()) / math.sqrt(power)
    return math.log((across + 1.0) / (beside + 1.0)) > correlation


def _common_texture(grey: Grey, column: int) -> float:
    """Correlate the texture of both sides of a column, -1 to 1."""
    left = grey[:, column - 2 : column]
    right = grey[:, column + 1 : column + 3]
    return common_texture(left, right)
