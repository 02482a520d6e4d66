"""Where a court lies: its whole template laid over the lines of a patch, at every place, angle and size nearby."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
from numpy.lib.stride_tricks import as_strided

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.courts.template import Template

_HALF_LINE_PX = 2  # a line is brighter than what lies so far to either side of it
_LEAST_CONTRAST = 3.0  # grey levels
_CONTRAST_PER_TEXTURE = 1.5
_TEXTURE_PX, _SMOOTH_PX = 15, 5
_MARGIN_M = 1.5
_LONG = 0.35  # of a court's length: its longer lines alone tell where all of them are looked at
_LOOKED_AT = 48  # places and sizes of an angle


class Pose(NamedTuple):
    """A court in an image.

    Attributes:
        x: of its centre, pixels (the first pixel's centre is 0).
        y: of its centre.
        angle: of its long axis, radians from +x towards +y.
        px_per_m: pixels for each metre.
    """

    x: float
    y: float
    angle: float
    px_per_m: float


class Reach(NamedTuple):
    """How far around a pose is searched, and how finely.

    Attributes:
        angle: radians to either side.
        angle_step: radians.
        log_size: to either side.
        log_size_step: of the log.
        place: pixels to either side.
        place_step: pixels.
    """

    angle: float
    angle_step: float
    log_size: float
    log_size_step: float
    place: int
    place_step: int


def ridges(grey: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Find thin bright lines by how much they are brighter than both of their sides, next to the texture around.

    Args:
        grey: ``[h, w]`` grey levels.

    Returns:
        ``[h, w]`` in 0..1, for lines along rows and along columns.
    """
    texture = cv2.blur(cv2.absdiff(grey, cv2.blur(grey, (_SMOOTH_PX, _SMOOTH_PX))), (_TEXTURE_PX, _TEXTURE_PX))
    contrast = np.maximum(texture * np.float32(_CONTRAST_PER_TEXTURE), np.float32(_LEAST_CONTRAST))
    d = _HALF_LINE_PX
    wide = cv2.copyMakeBorder(grey, d, d, d, d, cv2.BORDER_REPLICATE)
    along = np.maximum(wide[: -2 * d, d:-d], wide[2 * d :, d:-d])
    across = np.maximum(wide[d:-d, : -2 * d], wide[d:-d, 2 * d :])
    return _clearness(grey, along, contrast), _clearness(grey, across, contrast)


def _clearness(
    grey: NDArray[np.float32], beside: NDArray[np.float32], contrast: NDArray[np.float32]
) -> NDArray[np.float32]:
    """By how much a pixel is brighter than what lies beside it, over the contrast of a line, 0..1; into ``beside``."""
    clear = np.divide(np.subtract(grey, beside, out=beside), contrast, out=beside)
    cv2.threshold(clear, 0.0, 0.0, cv2.THRESH_TOZERO, dst=clear)
    cv2.threshold(clear, 1.0, 0.0, cv2.THRESH_TRUNC, dst=clear)
    return clear


def match(
    grey: NDArray[np.float32],
    templates: Sequence[Template],
    start: Pose,
    reach: Reach,
    angles: Sequence[float] | None = None,
) -> list[tuple[float, Pose]]:
    """Lay templates over the lines near a pose.

    Args:
        grey: ``[h, w]`` grey levels around it.
        templates: of the courts that it may be.
        start: where to search; its size is that of the first template, that of the others makes courts as long.
        reach: how far.
        angles: around which it is searched, radians; None for the pose's own.

    Returns:
        For each template the best score and its pose: the share of the template under which there are lines, less that
        of where no line should be. 1 at most.
    """
    best = [(-1.0, start)] * len(templates)
    sizes = [
        start.px_per_m * templates[0].length_m / template.length_m * np.exp(_steps(reach.log_size, reach.log_size_step))
        for template in templates
    ]
    halves = [
        (np.array([template.length_m, template.width_m]) / 2 + _MARGIN_M) * each[-1]
        for template, each in zip(templates, sizes, strict=True)
    ]
    half_x, half_y = (int(half) for half in np.ceil(np.max(halves, axis=0)) + reach.place + 2)
    places = np.arange(-reach.place, reach.place + 1, reach.place_step)
    ends = [_Ends.of(template, each, places, half_x, half_y) for template, each in zip(templates, sizes, strict=True)]
    turns = _steps(reach.angle, reach.angle_step)
    for angle in (each + turn for each in angles or (start.angle,) for turn in turns):
        sums = _turned_sums(grey, start, float(angle), half_x, half_y)
        cos, sin = np.cos(angle), np.sin(angle)
        for index, template_ends in enumerate(ends):
            score, size, row, column = template_ends.best(sums)
            if score > best[index][0]:
                dx, dy = places[column], places[row]
                x, y = start.x + cos * dx - sin * dy, start.y + sin * dx + cos * dy
                best[index] = score, Pose(float(x), float(y), float(angle), float(sizes[index][size]))
    return best


def _steps(reach: float, step: float) -> NDArray[np.float64]:
    count = round(reach / step)
    return np.arange(-count, count + 1, dtype=np.float64) * step


def _turned_sums(grey: NDArray[np.float32], start: Pose, angle: float, half_x: int, half_y: int) -> NDArray[np.float32]:
    """The lines around a pose, turned so that the court lies along rows, summed from the left and from the top, flat.

    Rows of ``2 half_x + 2``: first ``2 half_y + 1`` of lines along rows, then ``2 half_y + 2`` of those across, whose
    last column is empty.
    """
    cos, sin = np.cos(angle), np.sin(angle)
    x, y = start.x - cos * half_x + sin * half_y, start.y - sin * half_x - cos * half_y
    turned = cv2.warpAffine(
        grey,
        np.array([[cos, -sin, x], [sin, cos, y]]),
        (2 * half_x + 1, 2 * half_y + 1),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    along, across = ridges(np.asarray(turned, np.float32))
    rows, columns = along.shape
    sums = np.zeros((2 * rows + 1, columns + 1), np.float32)
    np.cumsum(cv2.dilate(along, np.ones((3, 1))), axis=1, out=sums[:rows, 1:])  # a pixel off still counts
    np.cumsum(cv2.dilate(across, np.ones((1, 3))), axis=0, out=sums[rows + 1 :, :-1])
    return sums.ravel()


class _Lines(NamedTuple):
    """The lines of a template that are laid, painted ones and blanks.

    Attributes:
        metres: ``[lines, 4]`` their ends.
        shares: ``[lines]`` of the score, negative where no line should be.
        along: ``[lines]`` whether they run along the court.
        long: indices of those that are painted and long: by them alone it is told where to look at all.
    """

    metres: NDArray[np.float64]
    shares: NDArray[np.float64]
    along: NDArray[np.bool_]
    long: NDArray[np.intp]


@cache
def _lines(template: Template) -> _Lines:
    lines = np.array([*template.lines, *template.blank])
    metres = np.hypot(lines[:, 2] - lines[:, 0], lines[:, 3] - lines[:, 1])
    wanted = np.arange(len(lines)) < len(template.lines)
    shares = np.where(wanted, metres / metres[wanted].sum(), -metres / metres[~wanted].sum())
    (long,) = np.nonzero(wanted & (metres >= _LONG * template.length_m))
    return _Lines(lines, shares, lines[:, 1] == lines[:, 3], long)


class _Ends(NamedTuple):
    """Where the sums of a template's lines are read, for a court at the patch's centre and around it.

    Attributes:
        first: ``[sizes, lines]`` index of each line's beginning.
        last: of its end.
        weights: ``[sizes, lines]``, 1 over its pixels, times its share of the lines; negative where none should be.
        shift: ``[places, places]`` what is added to an index for a court so far down and across.
        long: ``first``, ``last`` and ``weights`` of the lines that are painted and long, at the first of the places.
    """

    first: NDArray[np.intp]
    last: NDArray[np.intp]
    weights: NDArray[np.float32]
    shift: NDArray[np.intp]
    long: tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]

    @classmethod
    def of(
        cls, template: Template, sizes: NDArray[np.float64], places: NDArray[np.intp], half_x: int, half_y: int
    ) -> _Ends:
        """Those of a template in every size."""
        lines, shares, along, long = _lines(template)
        pixels = np.rint(lines[None] * sizes[:, None, None]).astype(np.intp)
        x1, y1, x2, y2 = np.moveaxis(pixels, 2, 0)
        pitch = 2 * half_x + 2
        base = np.where(along, 0, (2 * half_y + 1) * pitch) + half_y * pitch + half_x
        first = base + y1 * pitch + x1
        last = base + (y2 + ~along) * pitch + x2 + along
        weights = np.asarray(shares / (np.where(along, x2 - x1, y2 - y1) + 1), np.float32)
        shift = pitch * places[:, None] + places
        of_long = first[:, long] + shift[0, 0], last[:, long] + shift[0, 0], weights[:, long]
        return cls(first, last, weights, shift, of_long)

    def best(self, sums: NDArray[np.float32]) -> tuple[float, int, int, int]:
        """The best score, and the indices of its size, row and column, of all places of the centre."""
        first, last, weights = self.long
        everywhere = self._everywhere(sums)
        seen = everywhere[last]
        seen -= everywhere[first]
        told = np.einsum("sl,slp->sp", weights, seen.reshape(*seen.shape[:2], -1)).ravel()
        kept = np.argpartition(told, -_LOOKED_AT)[-_LOOKED_AT:] if len(told) > _LOOKED_AT else np.arange(len(told))
        size, place = np.divmod(kept, self.shift.size)
        there = self.shift.ravel()[place, None]
        whole = self.weights[size] * (sums.take(self.last[size] + there) - sums.take(self.first[size] + there))
        scores = whole.sum(axis=1)
        top = int(scores.argmax())
        row, column = divmod(int(place[top]), len(self.shift))
        return float(scores[top]), int(size[top]), row, column

    def _everywhere(self, sums: NDArray[np.float32]) -> NDArray[np.float32]:
        """``[index, places, places]``: from each index on, the sums at all places; a view of them."""
        shift, width = self.shift - self.shift[0, 0], sums.itemsize
        strides = width, width * int(shift[1, 0]), width * int(shift[0, 1])
        return as_strided(sums, (len(sums) - int(shift[-1, -1]), *shift.shape), strides, writeable=False)
