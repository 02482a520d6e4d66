"""Templates of courts, and their matching: a whole template is tried at every nearby position, angle and size.

A template has the painted lines in metres, by the rules of the game. The origin is the centre of
the court, and x runs along it. Rules measure to the outside of lines, a fit finds their middle. The
templates are therefore smaller by half a line's usual width.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

_HALF_LINE_PX = 2  # a line is brighter than the pixels this far to either side
_LEAST_CONTRAST = 3.0  # grey levels
_CONTRAST_PER_TEXTURE = 1.5
_TEXTURE_PX = 15
_SMOOTH_PX = 5
_MARGIN_M = 1.5
_HALF_LINE_M = 0.025  # tennis: 2.5 to 5 cm, base lines up to 10 cm (ITF); basketball: 5 cm (FIBA)
_ARC_STEPS = 16


class Pose(NamedTuple):
    """Position, angle and size of a court in an image.

    Attributes:
        x: column of its centre (0 is the centre of the first pixel).
        y: row of its centre.
        angle: direction of its long axis, radians from +x towards +y.
        px_per_m: pixels per metre.
    """

    x: float
    y: float
    angle: float
    px_per_m: float


def ridges(grey: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Find thin bright lines: pixels brighter than both sides, relative to the surrounding texture.

    Args:
        grey: ``[h, w]`` grey levels.

    Returns:
        Two ``[h, w]`` maps in 0..1: lines along rows, and lines along columns.
    """
    texture = cv2.blur(
        cv2.absdiff(grey, cv2.blur(grey, (_SMOOTH_PX, _SMOOTH_PX))), (_TEXTURE_PX, _TEXTURE_PX)
    )
    contrast = np.maximum(texture * np.float32(_CONTRAST_PER_TEXTURE), np.float32(_LEAST_CONTRAST))
    d = _HALF_LINE_PX
    wide = cv2.copyMakeBorder(grey, d, d, d, d, cv2.BORDER_REPLICATE)
    along = np.maximum(wide[: -2 * d, d:-d], wide[2 * d :, d:-d])
    across = np.maximum(wide[d:-d, : -2 * d], wide[d:-d, 2 * d :])
    return np.clip((grey - along) / contrast, 0, 1), np.clip((grey - across) / contrast, 0, 1)


def match(
    grey: NDArray[np.float32],
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
        places: pixels to try to either side, along and across, rising.
        angles: to try, radians.

    Returns:
        The best score and pose for each template. The score, at most 1, is the share of the
        template that lies on lines, minus the share of its blank segments that does.
    """
    best = [(-1.0, start)] * len(templates)
    sizes = [
        start.px_per_m * templates[0].length_m / template.length_m * np.exp(log_sizes)
        for template in templates
    ]
    halves = [
        (np.array([template.length_m, template.width_m]) / 2 + _MARGIN_M) * each[-1]
        for template, each in zip(templates, sizes, strict=True)
    ]
    half_x, half_y = (int(half) for half in np.ceil(np.max(halves, axis=0)) + places[-1] + 2)
    ends = [
        _Ends.of(template, each, places, half_x, half_y)
        for template, each in zip(templates, sizes, strict=True)
    ]
    for angle in angles:
        sums = _turned_sums(grey, start, angle=angle, half_x=half_x, half_y=half_y)
        cos = np.cos(angle)
        sin = np.sin(angle)
        for index, template_ends in enumerate(ends):
            score, size, row, column = template_ends.best(sums)
            if score > best[index][0]:
                dx = places[column]
                dy = places[row]
                x = start.x + cos * dx - sin * dy
                y = start.y + sin * dx + cos * dy
                best[index] = score, Pose(float(x), float(y), angle, float(sizes[index][size]))
    return best


def _turned_sums(
    grey: NDArray[np.float32], start: Pose, angle: float, half_x: int, half_y: int
) -> NDArray[np.float32]:
    """Compute cumulative sums of the lines around a pose, rotated so that the court lies along rows; flattened.

    Rows have ``2 half_x + 2`` values. The first ``2 half_y + 1`` rows hold lines along rows, the
    next ``2 half_y + 2`` lines across, whose last column is empty.
    """
    cos = np.cos(angle)
    sin = np.sin(angle)
    x = start.x - cos * half_x + sin * half_y
    y = start.y - sin * half_x - cos * half_y
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
    # tolerates an offset of one pixel
    np.cumsum(cv2.dilate(along, np.ones((3, 1))), axis=1, out=sums[:rows, 1:])
    np.cumsum(cv2.dilate(across, np.ones((1, 3))), axis=0, out=sums[rows + 1 :, :-1])
    return sums.ravel()


class _Ends(NamedTuple):
    """Indices into the cumulative sums for the segments of a template at and around the patch's centre.

    Attributes:
        first: ``[sizes, lines]`` index of each segment's start.
        last: ``[sizes, lines]`` index of each segment's end.
        weights: ``[sizes, lines]`` share of the score divided by the length in pixels; negative for
            blanks.
        shift: ``[places, places]`` offsets of the indices for a court that far down and across.
    """

    first: NDArray[np.intp]
    last: NDArray[np.intp]
    weights: NDArray[np.float32]
    shift: NDArray[np.intp]

    @classmethod
    def of(
        cls,
        template: Template,
        sizes: NDArray[np.float64],
        places: NDArray[np.intp],
        half_x: int,
        half_y: int,
    ) -> _Ends:
        """Compute the indices of a template for every size."""
        lines = np.concatenate([template.lines, template.blank])
        metres = np.hypot(lines[:, 2] - lines[:, 0], lines[:, 3] - lines[:, 1])
        wanted = np.arange(len(lines)) < len(template.lines)
        along = lines[:, 1] == lines[:, 3]
        shares = np.where(wanted, metres / metres[wanted].sum(), -metres / metres[~wanted].sum())
        pixels = np.rint(lines[None] * sizes[:, None, None]).astype(np.intp)
        x1, y1, x2, y2 = np.moveaxis(pixels, 2, 0)
        pitch = 2 * half_x + 2
        base = np.where(along, 0, (2 * half_y + 1) * pitch) + half_y * pitch + half_x
        first = base + y1 * pitch + x1
        last = base + (y2 + ~along) * pitch + x2 + along
        weights = np.asarray(shares / (np.where(along, x2 - x1, y2 - y1) + 1), np.float32)
        return cls(first, last, weights, pitch * places[:, None] + places)

    def best(self, sums: NDArray[np.float32]) -> tuple[float, int, int, int]:
        """Find the best score over all positions, and the indices of its size, row and column."""
        scores = np.zeros((len(self.first), *self.shift.shape), np.float32)
        for line, first, last in zip(self.weights.T, self.first.T, self.last.T, strict=True):
            seen = sums.take(last[:, None, None] + self.shift) - sums.take(
                first[:, None, None] + self.shift
            )
            scores += line[:, None, None] * seen
        size, row, column = np.unravel_index(int(scores.argmax()), scores.shape)
        return float(scores[size, row, column]), int(size), int(row), int(column)


@dataclass(frozen=True, eq=False)
class Template:
    """Template of one kind of court; lines are rows ``(x1, y1, x2, y2)``, metres along and across from its centre.

    Attributes:
        kind: ``tennis``, ``basketball_fiba``, ``basketball_nba`` or ``basketball_ncaa``.
        length_m: length to the outside of the lines.
        width_m: width to the outside of the lines.
        lines: ``[n, 4]`` straight lines along or across the court, used to find it.
        blank: ``[n, 4]`` segments without paint between and around the lines; lines there are a car
            park's or a roof's.
        arcs: ``[n, 4]`` all other paint, as short straight pieces.
    """

    kind: str
    length_m: float
    width_m: float
    lines: NDArray[np.float64]
    blank: NDArray[np.float64]
    arcs: NDArray[np.float64]

    @property
    def outline(self) -> NDArray[np.float64]:
        """Corners ``[4, 2]`` in metres; the first two bound a long side."""
        return np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * [
            self.length_m / 2,
            self.width_m / 2,
        ]


def _tennis() -> Template:
    x = 23.77 / 2 - _HALF_LINE_M
    y = 10.97 / 2 - _HALF_LINE_M
    singles = 8.23 / 2 - _HALF_LINE_M
    service = 6.40 - _HALF_LINE_M
    lines = [(-x, side, x, side) for side in (-y, y, -singles, singles)]
    lines += [(end, -y, end, y) for end in (-x, x)]
    lines += [(end, -singles, end, singles) for end in (-service, service)]
    lines.append((-service, 0.0, service, 0.0))
    blank = [(0.8 - x, side, x - 0.8, side) for side in (-singles / 2, singles / 2)]
    blank += [(-x, side, x, side) for side in (-y - 1.2, y + 1.2)]
    blank += [(end, 0.4 - singles, end, singles - 0.4) for end in (-9.1, 9.1)]
    blank += [(end, -y, end, y) for end in (-x - 1.2, x + 1.2)]
    return Template(
        "tennis",
        23.77,
        width_m=10.97,
        lines=np.array(lines),
        blank=np.array(blank),
        arcs=np.zeros((0, 4)),
    )


def _basketball(kind: str) -> Template:
    length, width, key_length, key_width, arc, from_side = {
        "basketball_fiba": (28.0, 15.0, 5.8, 4.9, 6.75, 0.9),
        "basketball_nba": (28.65, 15.24, 5.79, 4.88, 7.24, 0.91),
        "basketball_ncaa": (28.65, 15.24, 5.79, 3.66, 6.75, 1.02),
    }[kind]
    x = length / 2 - _HALF_LINE_M
    y = width / 2 - _HALF_LINE_M
    key = key_width / 2 - _HALF_LINE_M
    free = length / 2 - key_length + _HALF_LINE_M
    lines = [(-x, side, x, side) for side in (-y, y)]
    lines += [(end, -y, end, y) for end in (-x, 0.0, x)]
    lines += [(end * free, side, end * x, side) for end in (-1, 1) for side in (-key, key)]
    lines += [(end * free, -key, end * free, key) for end in (-1, 1)]
    blank = [(-x, side, x, side) for side in (-y - 1.2, y + 1.2)]
    blank += [(end, -y, end, y) for end in (-x - 1.2, x + 1.2)]
    blank += [(-4.5, side, 4.5, side) for side in (-4.6, 4.6)]
    blank += [(end, -y + 0.8, end, y - 0.8) for end in (-3.2, 3.2)]
    straight = width / 2 - from_side - _HALF_LINE_M
    reach = arc - _HALF_LINE_M
    turn = np.arcsin(straight / reach)
    angles = np.linspace(-turn, turn, _ARC_STEPS)
    basket = length / 2 - 1.575
    arcs = [np.stack([1.8 * np.cos(a := np.linspace(0, 2 * np.pi, 20)), 1.8 * np.sin(a)], axis=1)]
    for end in (-1.0, 1.0):
        arcs.append(
            np.stack([end * (basket - reach * np.cos(angles)), reach * np.sin(angles)], axis=1)
        )
    pieces = np.concatenate([np.hstack([arc[:-1], arc[1:]]) for arc in arcs])
    return Template(
        kind, length, width_m=width, lines=np.array(lines), blank=np.array(blank), arcs=pieces
    )


TENNIS = _tennis()
"""ITF, Rules of Tennis, rule 1: 23.77 x 10.97 m for doubles, 8.23 m wide for singles, service lines 6.40 m from the
net."""

BASKETBALL = tuple(
    _basketball(kind) for kind in ("basketball_fiba", "basketball_nba", "basketball_ncaa")
)
"""FIBA, Official Basketball Rules, article 2: 28 x 15 m; NBA and NCAA rule books, rule 1: 94 x 50 ft."""
