"""Templates of courts: the painted lines in metres, by the rules of the game.

The origin is the centre of the court, and x runs along it. Rules measure to the outside of lines,
but a fit finds their middle. The templates are therefore smaller by half a line's usual width.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Lines: TypeAlias = NDArray[np.float64]
    """``[n, 4]`` lines ``(x1, y1, x2, y2)``, metres along and across from the court's centre."""

    Line: TypeAlias = tuple[float, ...]
    """``(x1, y1, x2, y2)``, metres along and across from the court's centre."""

# Tennis: lines of 2.5 to 5 cm, base lines up to 10 cm (ITF). Basketball: 5 cm (FIBA).
_HALF_LINE_M = 0.025
# Distance of the blank segments around a court from its outline.
_AROUND_M = 1.2
# Straight pieces of a three-point arc and of the centre circle, plus one.
_ARC_POINTS = 16
_CIRCLE_POINTS = 20
# Basketball: radius of the centre circle, and distance of the basket from the end line.
_CIRCLE_RADIUS_M = 1.8
_BASKET_M = 1.575


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


@dataclass(frozen=True, eq=False)
class Template:
    """Template of one kind of court.

    Lines are rows ``(x1, y1, x2, y2)``, metres along and across from the court's centre.

    Attributes:
        kind: ``tennis``, ``basketball_fiba``, ``basketball_nba`` or ``basketball_ncaa``.
        length_m: length to the outside of the lines.
        width_m: width to the outside of the lines.
        lines: ``[n, 4]`` straight lines along or across the court, used to find it.
        blank: ``[n, 4]`` segments without paint between and around the lines; lines there are a car
            park's or a roof's.
        arcs: ``[n, 4]`` all other paint, as short straight pieces.
        strips: ends of strips across the court, metres along it from its centre, in which all lines
            run along the court.
    """

    kind: str
    length_m: float
    width_m: float
    lines: Lines
    blank: Lines
    arcs: Lines
    strips: tuple[tuple[float, float], ...] = ()

    @property
    def lines_of_strips(self) -> NDArray[np.float64]:
        """Places ``[n]`` of the lines through all strips, metres across from the centre."""
        reach = max(max(map(abs, strip)) for strip in self.strips)
        runs_along = self.lines[:, 1] == self.lines[:, 3]
        is_long = np.abs(self.lines[:, ::2]).min(axis=1) >= reach
        return np.asarray(self.lines[runs_along & is_long, 1])

    @property
    def outline(self) -> NDArray[np.float64]:
        """Corners ``[4, 2]`` in metres; the first two bound a long side."""
        x = self.length_m / 2
        y = self.width_m / 2
        return np.array([(-x, -y), (x, -y), (x, y), (-x, y)])


def _along(xs: tuple[float, float], ys: tuple[float, ...]) -> list[Line]:
    """Draw lines along the court from one x to the other, at several y."""
    start, end = xs
    return [(start, y, end, y) for y in ys]


def _across(xs: tuple[float, ...], ys: tuple[float, float]) -> list[Line]:
    """Draw lines across the court from one y to the other, at several x."""
    start, end = ys
    return [(x, start, x, end) for x in xs]


def _tennis() -> Template:
    """Build the template of a tennis court for doubles."""
    length = 23.77
    width = 10.97
    x = length / 2 - _HALF_LINE_M
    y = width / 2 - _HALF_LINE_M
    singles = 8.23 / 2 - _HALF_LINE_M
    service = 6.40 - _HALF_LINE_M
    lines = [
        # Side lines for doubles and for singles, base lines, service lines, centre line.
        *_along((-x, x), (-y, y, -singles, singles)),
        *_across((-x, x), (-y, y)),
        *_across((-service, service), (-singles, singles)),
        *_along((-service, service), (0.0,)),
    ]
    blank = [
        *_along((0.8 - x, x - 0.8), (-singles / 2, singles / 2)),
        *_along((-x, x), (-y - _AROUND_M, y + _AROUND_M)),
        *_across((-9.1, 9.1), (0.4 - singles, singles - 0.4)),
        *_across((-x - _AROUND_M, x + _AROUND_M), (-y, y)),
    ]
    return Template(
        kind="tennis",
        length_m=length,
        width_m=width,
        lines=np.array(lines),
        blank=np.array(blank),
        arcs=np.zeros((0, 4)),
        strips=((6.9, 11.3), (-11.3, -6.9)),
    )


class _BasketballRules(NamedTuple):
    """Sizes of a basketball court to the outside of its lines, metres.

    Attributes:
        length: length of the court.
        width: width of the court.
        key_length: from the end line to the free-throw line.
        key_width: width of the restricted area.
        arc_radius: radius of the three-point line around the basket.
        arc_to_side: distance of its straight parts from the side line.
    """

    length: float
    width: float
    key_length: float
    key_width: float
    arc_radius: float
    arc_to_side: float


def _basketball(kind: str, rules: _BasketballRules) -> Template:
    """Build the template of a basketball court."""
    x = rules.length / 2 - _HALF_LINE_M
    y = rules.width / 2 - _HALF_LINE_M
    key = rules.key_width / 2 - _HALF_LINE_M
    free = rules.length / 2 - rules.key_length + _HALF_LINE_M
    lines = [
        # Side lines, end lines and centre line.
        *_along((-x, x), (-y, y)),
        *_across((-x, 0.0, x), (-y, y)),
        # Sides of the restricted areas, and free-throw lines.
        *_along((-free, -x), (-key, key)),
        *_along((free, x), (-key, key)),
        *_across((-free, free), (-key, key)),
    ]
    blank = [
        *_along((-x, x), (-y - _AROUND_M, y + _AROUND_M)),
        *_across((-x - _AROUND_M, x + _AROUND_M), (-y, y)),
        *_along((-4.5, 4.5), (-4.6, 4.6)),
        *_across((-3.2, 3.2), (-y + 0.8, y - 0.8)),
    ]
    return Template(
        kind=kind,
        length_m=rules.length,
        width_m=rules.width,
        lines=np.array(lines),
        blank=np.array(blank),
        arcs=_basketball_arcs(rules),
    )


def _basketball_arcs(rules: _BasketballRules) -> Lines:
    """Draw the centre circle and both three-point arcs as straight pieces ``[n, 4]``."""
    turns = np.linspace(0, 2 * np.pi, _CIRCLE_POINTS)
    circle_x = _CIRCLE_RADIUS_M * np.cos(turns)
    circle_y = _CIRCLE_RADIUS_M * np.sin(turns)
    curves = [np.stack([circle_x, circle_y], axis=1)]

    # An arc ends where the straight parts of the three-point line begin.
    radius = rules.arc_radius - _HALF_LINE_M
    straight = rules.width / 2 - rules.arc_to_side - _HALF_LINE_M
    end_angle = np.arcsin(straight / radius)
    angles = np.linspace(-end_angle, end_angle, _ARC_POINTS)
    basket = rules.length / 2 - _BASKET_M
    for end in (-1.0, 1.0):
        x = end * (basket - radius * np.cos(angles))
        y = radius * np.sin(angles)
        curves.append(np.stack([x, y], axis=1))
    pieces = [np.hstack([points[:-1], points[1:]]) for points in curves]
    return np.concatenate(pieces)


TENNIS = _tennis()
"""ITF, Rules of Tennis, rule 1: 23.77 x 10.97 m for doubles, 8.23 m wide for singles.

The service lines are 6.40 m from the net.
"""

BASKETBALL = (
    _basketball(
        "basketball_fiba",
        _BasketballRules(
            length=28.0,
            width=15.0,
            key_length=5.8,
            key_width=4.9,
            arc_radius=6.75,
            arc_to_side=0.9,
        ),
    ),
    _basketball(
        "basketball_nba",
        _BasketballRules(
            length=28.65,
            width=15.24,
            key_length=5.79,
            key_width=4.88,
            arc_radius=7.24,
            arc_to_side=0.91,
        ),
    ),
    _basketball(
        "basketball_ncaa",
        _BasketballRules(
            length=28.65,
            width=15.24,
            key_length=5.79,
            key_width=3.66,
            arc_radius=6.75,
            arc_to_side=1.02,
        ),
    ),
)
"""FIBA, Official Basketball Rules, article 2: 28 x 15 m; NBA and NCAA, rule 1: 94 x 50 ft."""

LENGTHS_M = (TENNIS.length_m, BASKETBALL[0].length_m)
"""Lengths of the courts of a proposal's game: tennis, basketball."""
