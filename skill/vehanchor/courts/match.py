"""Matching of courts: a whole template is tried at every nearby position, angle and size.

For each angle the image is rotated, so that the lines of a court lie along its rows and columns.
The paint below a line is then the difference of two cumulative sums.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import cv2
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from vehanchor.courts.templates import Pose

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.courts.templates import Template

    GreyImage: TypeAlias = NDArray[np.float32]
    """``[h, w]`` grey levels."""

    LineMap: TypeAlias = NDArray[np.float32]
    """``[h, w]`` strength of the line through each pixel, 0..1."""

    Indices: TypeAlias = NDArray[np.intp]
    """Rows and columns of the cumulative sums of the lines."""

# A line is brighter than the pixels this far to either side.
_HALF_LINE_PX = 2
# Contrast of a full line: grey levels, and multiples of the texture around it.
_MIN_CONTRAST = 3.0
_CONTRAST_PER_TEXTURE = 1.5
# Windows of the mean grey level, and of the mean deviation from it.
_SMOOTH_PX = 5
_TEXTURE_PX = 15
# Margin around a court that the rotated patch covers.
_MARGIN_M = 1.5


def ridges(grey: GreyImage) -> tuple[LineMap, LineMap]:
    """Find thin bright lines: pixels brighter than both sides, relative to the texture around.

    Args:
        grey: ``[h, w]`` grey levels.

    Returns:
        Two ``[h, w]`` maps in 0..1: lines along rows, and lines along columns.
    """
    smooth = cv2.blur(grey, (_SMOOTH_PX, _SMOOTH_PX))
    deviation = cv2.absdiff(grey, smooth)
    texture = cv2.blur(deviation, (_TEXTURE_PX, _TEXTURE_PX))
    contrast = texture * np.float32(_CONTRAST_PER_TEXTURE)
    contrast = np.maximum(contrast, np.float32(_MIN_CONTRAST))
    d = _HALF_LINE_PX
    wide = cv2.copyMakeBorder(grey, d, d, d, d, cv2.BORDER_REPLICATE)
    above = wide[: -2 * d, d:-d]
    below = wide[2 * d :, d:-d]
    left = wide[d:-d, : -2 * d]
    right = wide[d:-d, 2 * d :]
    ridge_along = grey - np.maximum(above, below)
    ridge_across = grey - np.maximum(left, right)
    along = np.clip(ridge_along / contrast, 0, 1)
    across = np.clip(ridge_across / contrast, 0, 1)
    return along, across


def match(
    grey: GreyImage,
    templates: Sequence[Template],
    start: Pose,
    log_sizes: NDArray[np.float64],
    places: NDArray[np.intp],
    angles: Sequence[float],
) -> list[tuple[float, Pose]]:
    """Match templates with the lines near a pose.

    Args:
        grey: ``[h, w]`` grey levels around the pose.
        templates: templates of the possible courts.
        start: centre of the search; its size belongs to the first template, the others are scaled
            to the same length.
        log_sizes: logarithms of the size ratios to try, rising.
        places: pixels to try to either side, along and across, rising at even steps.
        angles: to try, radians.

    Returns:
        The best score and pose for each template. The score, at most 1, is the share of the
        template that lies on lines, minus the share of its blank segments that does.
    """
    # Sizes in pixels per metre for each template: all templates are tried at the same lengths.
    length_px = start.px_per_m * templates[0].length_m
    size_ratios = np.exp(log_sizes)
    sizes = [length_px / template.length_m * size_ratios for template in templates]
    # Half sides of the patch: the largest court at the farthest place.
    halves = []
    for template, template_sizes in zip(templates, sizes, strict=True):
        sides_m = np.array([template.length_m, template.width_m])
        largest_size = template_sizes[-1]
        halves.append((sides_m / 2 + _MARGIN_M) * largest_size)
    largest_half = np.max(halves, axis=0)
    farthest = places[-1]
    reach = np.ceil(largest_half) + farthest + 2
    half_x = int(reach[0])
    half_y = int(reach[1])
    ends = [
        _Ends.of(template, template_sizes, places=places, half_x=half_x, half_y=half_y)
        for template, template_sizes in zip(templates, sizes, strict=True)
    ]

    best = [(-1.0, start)] * len(templates)
    for angle in angles:
        sums = _rotated_sums(grey, start, angle=angle, half_x=half_x, half_y=half_y)
        cos = np.cos(angle)
        sin = np.sin(angle)
        for index, template_ends in enumerate(ends):
            score, size, row, column = template_ends.best(sums)
            best_score, _ = best[index]
            if score <= best_score:
                continue
            dx = places[column]
            dy = places[row]
            x = float(start.x + cos * dx - sin * dy)
            y = float(start.y + sin * dx + cos * dy)
            px_per_m = float(sizes[index][size])
            best[index] = score, Pose(x, y, angle, px_per_m)
    return best


def _rotated_sums(
    grey: GreyImage, start: Pose, angle: float, half_x: int, half_y: int
) -> NDArray[np.float32]:
    """Compute cumulative sums of the lines around a pose, rotated so that it lies along rows.

    Returns:
        ``[4 half_y + 3, 2 half_x + 2]``. The first ``2 half_y + 1`` rows hold lines along rows. The
        others hold lines across; their last column is empty.
    """
    cos = np.cos(angle)
    sin = np.sin(angle)
    # Corner of the rotated patch, whose centre is the pose.
    x = start.x - cos * half_x + sin * half_y
    y = start.y - sin * half_x - cos * half_y
    patch_to_image = np.array([[cos, -sin, x], [sin, cos, y]])
    patch_size = (2 * half_x + 1, 2 * half_y + 1)
    rotated = cv2.warpAffine(
        grey,
        patch_to_image,
        patch_size,
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    along, across = ridges(np.asarray(rotated, np.float32))
    # Wider lines tolerate an offset of one pixel.
    brush = np.ones((3, 1))
    wide_along = cv2.dilate(along, brush)
    wide_across = cv2.dilate(across, brush.T)
    rows, columns = along.shape
    sums = np.zeros((2 * rows + 1, columns + 1), np.float32)
    sums_along = sums[:rows, 1:]
    sums_across = sums[rows + 1 :, :-1]
    np.cumsum(wide_along, axis=1, out=sums_along)
    np.cumsum(wide_across, axis=0, out=sums_across)
    return sums


class _Ends(NamedTuple):
    """Places in the cumulative sums for the segments of a template.

    Attributes:
        first: ``[2, lines, sizes]`` row and column of each segment's start, for a court at the
            first place down and across.
        last: ``[2, lines, sizes]`` row and column of each segment's end.
        weights: ``[lines, sizes]`` share of the score divided by the length in pixels; negative for
            blanks.
        places: pixels to try to either side, along and across, at even steps.
    """

    first: Indices
    last: Indices
    weights: NDArray[np.float32]
    places: Indices

    @classmethod
    def of(
        cls,
        template: Template,
        sizes: NDArray[np.float64],
        places: NDArray[np.intp],
        half_x: int,
        half_y: int,
    ) -> _Ends:
        """Compute the places of a template for every size.

        Args:
            template: the template.
            sizes: ``[sizes]`` pixels per metre.
            places: pixels to try to either side, along and across, at even steps.
            half_x: columns of the patch on either side of its centre.
            half_y: rows of the patch on either side of its centre.
        """
        lines = np.concatenate([template.lines, template.blank])
        is_paint = np.arange(len(lines)) < len(template.lines)
        is_along = lines[:, 1] == lines[:, 3]
        # A line counts by its share of the template's paint, a blank segment against it.
        steps = lines[:, 2:] - lines[:, :2]
        metres = np.hypot(*steps.T)
        paint_m = metres[is_paint].sum()
        blank_m = metres[~is_paint].sum()
        shares = np.where(is_paint, metres / paint_m, -metres / blank_m)
        lines_px = np.rint(lines[:, None] * sizes[:, None])
        x1, y1, x2, y2 = np.moveaxis(lines_px.astype(np.intp), 2, 0)
        is_along = is_along[:, None]
        n_pixels = np.where(is_along, x2 - x1, y2 - y1) + 1
        # The sum up to a segment's end is one place ahead of its pixel: to the right, or down.
        right = np.where(is_along, 1, 0)
        down = 1 - right
        first_row = np.where(is_along, 0, 2 * half_y + 1)
        row = first_row + half_y + places[0]
        column = half_x + places[0]
        return cls(
            first=np.stack([row + y1, column + x1]),
            last=np.stack([row + y2 + down, column + x2 + right]),
            weights=np.asarray(shares[:, None] / n_pixels, np.float32),
            places=places,
        )

    def best(self, sums: NDArray[np.float32]) -> tuple[float, int, int, int]:
        """Find the best score over all positions, and the indices of its size, row and column."""
        step = self.places[1] - self.places[0]
        side = self.places[-1] - self.places[0] + 1
        # The sums at all positions, for each place of a court at the first one.
        windows = sliding_window_view(sums, (side, side))[:, :, ::step, ::step]
        n_sizes = self.weights.shape[1]
        n_places = len(self.places)
        scores = np.zeros((n_sizes, n_places, n_places), np.float32)
        # For each line: the paint below it at all sizes and positions.
        firsts = zip(*self.first, strict=True)
        lasts = zip(*self.last, strict=True)
        for first, last, weights in zip(firsts, lasts, self.weights, strict=True):
            paint = windows[last]
            paint -= windows[first]
            paint *= weights[:, None, None]
            scores += paint
        best = int(scores.argmax())
        size, row, column = np.unravel_index(best, scores.shape)
        best_score = float(scores[size, row, column])
        return best_score, int(size), int(row), int(column)
