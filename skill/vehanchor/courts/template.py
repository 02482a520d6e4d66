"""Painted lines of courts in metres, by the rules of the games.

The origin is the centre of the court, and x runs along it. Rules measure to the outside of lines, a fit finds their
middle. The templates are therefore smaller by half a line's usual width.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

_HALF_LINE_M = 0.025  # tennis: 2.5 to 5 cm, base lines up to 10 cm (ITF); basketball: 5 cm (FIBA)
_ARC_STEPS = 16


class Line(NamedTuple):
    """Straight painted line.

    Attributes:
        x1: first end, metres along the court from its centre.
        y1: first end, metres across.
        x2: second end, metres along.
        y2: second end, metres across.
    """

    x1: float
    y1: float
    x2: float
    y2: float

    @property
    def length_m(self) -> float:
        """Length in metres."""
        return float(np.hypot(self.x2 - self.x1, self.y2 - self.y1))


@dataclass(frozen=True)
class Template:
    """Template of one kind of court.

    Attributes:
        kind: ``tennis``, ``basketball_fiba``, ``basketball_nba`` or ``basketball_ncaa``.
        length_m: length to the outside of the lines.
        width_m: width to the outside of the lines.
        lines: straight lines along or across the court, used to find it.
        blank: segments without paint between and around the lines; lines there indicate a car park or a roof.
        arcs: all other paint, as short straight pieces.
    """

    kind: str
    length_m: float
    width_m: float
    lines: tuple[Line, ...]
    blank: tuple[Line, ...]
    arcs: tuple[Line, ...] = ()

    @property
    def outline(self) -> NDArray[np.float64]:
        """Corners ``[4, 2]`` in metres; the first two bound a long side."""
        return np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * [self.length_m / 2, self.width_m / 2]


def _tennis() -> Template:
    x, y = 23.77 / 2 - _HALF_LINE_M, 10.97 / 2 - _HALF_LINE_M
    singles, service = 8.23 / 2 - _HALF_LINE_M, 6.40 - _HALF_LINE_M
    lines = [Line(-x, side, x, side) for side in (-y, y, -singles, singles)]
    lines += [Line(end, -y, end, y) for end in (-x, x)]
    lines += [Line(end, -singles, end, singles) for end in (-service, service)]
    lines.append(Line(-service, 0.0, service, 0.0))
    blank = [Line(0.8 - x, side, x - 0.8, side) for side in (-singles / 2, singles / 2)]
    blank += [Line(-x, side, x, side) for side in (-y - 1.2, y + 1.2)]
    blank += [Line(end, 0.4 - singles, end, singles - 0.4) for end in (-9.1, 9.1)]
    blank += [Line(end, -y, end, y) for end in (-x - 1.2, x + 1.2)]
    return Template("tennis", 23.77, 10.97, tuple(lines), tuple(blank))


def _basketball(kind: str) -> Template:
    length, width, key_length, key_width, arc, from_side = {
        "basketball_fiba": (28.0, 15.0, 5.8, 4.9, 6.75, 0.9),
        "basketball_nba": (28.65, 15.24, 5.79, 4.88, 7.24, 0.91),
        "basketball_ncaa": (28.65, 15.24, 5.79, 3.66, 6.75, 1.02),
    }[kind]
    x, y = length / 2 - _HALF_LINE_M, width / 2 - _HALF_LINE_M
    key, free = key_width / 2 - _HALF_LINE_M, length / 2 - key_length + _HALF_LINE_M
    lines = [Line(-x, side, x, side) for side in (-y, y)]
    lines += [Line(end, -y, end, y) for end in (-x, 0.0, x)]
    lines += [Line(end * free, side, end * x, side) for end in (-1, 1) for side in (-key, key)]
    lines += [Line(end * free, -key, end * free, key) for end in (-1, 1)]
    blank = [Line(-x, side, x, side) for side in (-y - 1.2, y + 1.2)]
    blank += [Line(end, -y, end, y) for end in (-x - 1.2, x + 1.2)]
    blank += [Line(-4.5, side, 4.5, side) for side in (-4.6, 4.6)]
    blank += [Line(end, -y + 0.8, end, y - 0.8) for end in (-3.2, 3.2)]
    straight, reach = width / 2 - from_side - _HALF_LINE_M, arc - _HALF_LINE_M
    turn = np.arcsin(straight / reach)
    angles = np.linspace(-turn, turn, _ARC_STEPS)
    basket = length / 2 - 1.575
    arcs = _pieces(np.stack([1.8 * np.cos(a := np.linspace(0, 2 * np.pi, 20)), 1.8 * np.sin(a)], axis=1))
    for end in (-1.0, 1.0):
        arcs += _pieces(np.stack([end * (basket - reach * np.cos(angles)), reach * np.sin(angles)], axis=1))
    return Template(kind, length, width, tuple(lines), tuple(blank), tuple(arcs))


def _pieces(points: NDArray[np.float64]) -> list[Line]:
    return [Line(*map(float, (*a, *b))) for a, b in pairwise(points)]


TENNIS = _tennis()
"""ITF, Rules of Tennis, rule 1: 23.77 x 10.97 m for doubles, 8.23 m wide for singles, service lines 6.40 m from the
net."""

BASKETBALL = tuple(_basketball(kind) for kind in ("basketball_fiba", "basketball_nba", "basketball_ncaa"))
"""FIBA, Official Basketball Rules, article 2: 28 x 15 m; NBA and NCAA rule books, rule 1: 94 x 50 ft."""
