"""Where a court lies: its whole template laid over the lines of a patch, at every place, angle and size nearby."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.courts.template import Template

__all__ = ["Pose", "Reach", "match", "ridges"]

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
    texture = cv2.blur(np.abs(grey - cv2.blur(grey, (_SMOOTH_PX, _SMOOTH_PX))), (_TEXTURE_PX, _TEXTURE_PX))
    contrast = np.maximum(_LEAST_CONTRAST, _CONTRAST_PER_TEXTURE * texture)
    d = _HALF_LINE_PX
    wide = cv2.copyMakeBorder(grey, d, d, d, d, cv2.BORDER_REPLICATE)
    along = grey - np.maximum(wide[: -2 * d, d:-d], wide[2 * d :, d:-d])
    across = grey - np.maximum(wide[d:-d, : -2 * d], wide[d:-d, 2 * d :])
    return np.clip(along / contrast, 0, 1), np.clip(across / contrast, 0, 1)


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
    ends = [_Ends.of(template, each, half_x, half_y) for template, each in zip(templates, sizes, strict=True)]
    turns = _steps(reach.angle, reach.angle_step)
    for angle in (each + turn for each in angles or (start.angle,) for turn in turns):
        sums = _turned_sums(grey, start, float(angle), half_x, half_y)
        cos, sin = np.cos(angle), np.sin(angle)
        for index, template_ends in enumerate(ends):
            score, size, row, column = template_ends.best(sums, places)
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

    First ``[2 half_y + 1, 2 half_x + 2]`` of lines along rows, then ``[2 half_y + 2, 2 half_x + 1]`` of those across.
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
    sums = np.zeros(rows * (columns + 1) + (rows + 1) * columns, np.float32)
    first = sums[: rows * (columns + 1)].reshape(rows, columns + 1)
    second = sums[rows * (columns + 1) :].reshape(rows + 1, columns)
    np.cumsum(cv2.dilate(along, np.ones((3, 1))), axis=1, out=first[:, 1:])  # a pixel off still counts
    np.cumsum(cv2.dilate(across, np.ones((1, 3))), axis=0, out=second[1:])
    return sums


class _Ends(NamedTuple):
    """Where the sums of a template's lines are read, for a court at the patch's centre.

    Attributes:
        first: ``[sizes, lines]`` index of each line's beginning.
        last: of its end.
        weights: ``[sizes, lines]``, 1 over its pixels, times its share of the lines; negative where none should be.
        steps: ``[lines, 2]`` what a row and a column of the patch add to an index.
        long: indices of the lines that are painted and long: by them alone it is told where to look at all.
    """

    first: NDArray[np.intp]
    last: NDArray[np.intp]
    weights: NDArray[np.float32]
    steps: NDArray[np.intp]
    long: NDArray[np.intp]

    @classmethod
    def of(cls, template: Template, sizes: NDArray[np.float64], half_x: int, half_y: int) -> _Ends:
        """Those of a template in every size."""
        lines = np.array([*template.lines, *template.blank])
        metres = np.hypot(lines[:, 2] - lines[:, 0], lines[:, 3] - lines[:, 1])
        wanted = np.arange(len(lines)) < len(template.lines)
        shares = np.where(wanted, metres / metres[wanted].sum(), -metres / metres[~wanted].sum())
        pixels = np.rint(lines[None] * sizes[:, None, None]).astype(np.intp)
        along = lines[:, 1] == lines[:, 3]
        x1, y1, x2, y2 = np.moveaxis(pixels, 2, 0)
        width = 2 * half_x + 1
        below = (2 * half_y + 1) * (width + 1)  # where the second sums begin
        pitch = np.where(along, width + 1, width)
        base = np.where(along, 0, below)
        first = base + (half_y + y1) * pitch + half_x + x1
        last = base + (half_y + y2 + ~along) * pitch + half_x + x2 + along
        count = np.where(along, x2 - x1, y2 - y1) + 1
        steps = np.stack([pitch, np.ones_like(pitch)], axis=1)
        (long,) = np.nonzero(wanted & (metres >= _LONG * template.length_m))
        return cls(first, last, np.asarray(shares / count, np.float32), steps, long)

    def best(self, sums: NDArray[np.float32], places: NDArray[np.intp]) -> tuple[float, int, int, int]:
        """The best score, and the indices of its size, row and column, of all places of the centre."""
        rows, columns = (each.ravel() for each in np.meshgrid(places, places, indexing="ij"))
        shift = self.steps[:, :1] * rows + self.steps[:, 1:] * columns  # [lines, places]
        few = shift[self.long]
        seen = sums[self.last[:, self.long, None] + few] - sums[self.first[:, self.long, None] + few]
        told = np.einsum("sl,slp->sp", self.weights[:, self.long], seen).ravel()
        kept = np.argpartition(told, -_LOOKED_AT)[-_LOOKED_AT:] if len(told) > _LOOKED_AT else np.arange(len(told))
        size, place = np.unravel_index(kept, (len(self.weights), shift.shape[1]))
        there = shift.T[place]
        whole = self.weights[size] * (sums[self.last[size] + there] - sums[self.first[size] + there])
        scores = whole.sum(axis=1)
        top = int(scores.argmax())
        row, column = divmod(int(place[top]), len(places))
        return float(scores[top]), int(size[top]), row, column
