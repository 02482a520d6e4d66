"""Draw the chances of answers against the share that is right, from ``scale.json``, as SVG."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from research.results.record import Table

if TYPE_CHECKING:
    from collections.abc import Mapping
    from typing import Any

_WIDTH = 640
_HEIGHT = 480
_LEFT = 60
_TOP = 20
_SIDE = 390
# Percentages at the lower left and the upper right corner.
_LEAST = 40.0
_MOST = 100.0
_TICKS = (40, 50, 60, 70, 80, 90, 100)
# Smaller bins say nothing.
_FEWEST = 30
# Smallest variance, so that a certain answer has a standard error.
_LEAST_VARIANCE = 1e-4


class Series(NamedTuple):
    """Bins of one colour.

    Attributes:
        entry: name of their table in ``scale.json``.
        cars: their group in that table.
        label: text of the legend.
        colour: of their marks.
    """

    entry: str
    cars: str
    label: str
    colour: str


SERIES = (
    Series("calibration", "5 and more", "5 cars and more", "#999999"),
    Series("calibration", "1 to 4", "1 to 4 cars", "#0072B2"),
    Series("calibration_unseen", "1 to 4", "1 to 4, never learned", "#D55E00"),
)


def calibration_figure(scale: Mapping[str, Mapping[str, Any]]) -> str:
    """Draw each bin as a point with two standard errors to either side.

    Args:
        scale: content of ``scale.json``.

    Returns:
        An SVG document.
    """
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {_HEIGHT}"'
        ' font-family="sans-serif" font-size="13">',
        "<title>Chance of answers against the share that is right</title>",
        f'<rect width="{_WIDTH}" height="{_HEIGHT}" fill="white"/>',
        *_axes(),
    ]
    for number, series in enumerate(SERIES):
        entry = scale[series.entry]
        table = Table(entry["columns"], entry["units"], entry["rows"])
        parts += _marks(series, table)
        parts += _legend(series, number)
    parts.append("</svg>")
    return "\n".join(parts) + "\n"


def _axes() -> list[str]:
    """Draw the frame, the ticks, the titles, and the line on which chances are right."""
    corner = f'x="{_LEFT}" y="{_TOP}"'
    parts = [
        f'<rect {corner} width="{_SIDE}" height="{_SIDE}" fill="none" stroke="black"/>',
        _line(_LEAST, _LEAST, _MOST, _MOST, colour="black"),
    ]
    for tick in _TICKS:
        x = _x(tick)
        y = _y(tick)
        parts.append(_text(x, _TOP + _SIDE + 18, f"{tick}", anchor="middle"))
        parts.append(_text(_LEFT - 8, y + 4, f"{tick}", anchor="end"))
    middle = _LEFT + _SIDE / 2
    parts.append(_text(middle, _HEIGHT - 30, "chance, mean of the bin, %", anchor="middle"))
    turned = f'transform="rotate(-90 16 {_TOP + _SIDE / 2:.1f})"'
    parts.append(_text(16, _TOP + _SIDE / 2, "right, %", anchor="middle", extra=turned))
    return parts


def _marks(series: Series, table: Table) -> list[str]:
    """Draw the bins of one series."""
    cars, chance, right, size = (
        table.columns.index(name) for name in ("cars", "chance", "right", "photographs")
    )
    parts = []
    for row in table.rows:
        if row[cars] != series.cars or _number(row[size]) < _FEWEST:
            continue
        stated = _number(row[chance])
        found = _number(row[right])
        share = stated / 100
        variance = max(share * (1 - share), _LEAST_VARIANCE)
        reach = 200 * math.sqrt(variance / _number(row[size]))
        low = max(found - reach, _LEAST)
        high = min(found + reach, _MOST)
        parts.append(_line(stated, low, stated, high, colour=series.colour))
        centre = f'cx="{_x(stated):.1f}" cy="{_y(found):.1f}"'
        parts.append(f'<circle {centre} r="4" fill="{series.colour}"/>')
    return parts


def _number(cell: float | str | None) -> float:
    """Return a cell that has a number."""
    assert isinstance(cell, float | int)
    return float(cell)


def _legend(series: Series, number: int) -> list[str]:
    """Draw the legend of one series."""
    x = _LEFT + _SIDE + 20
    y = _TOP + 20 + 22 * number
    return [
        f'<circle cx="{x}" cy="{y}" r="4" fill="{series.colour}"/>',
        _text(x + 10, y + 4, series.label),
    ]


def _line(
    from_chance: float, from_right: float, to_chance: float, to_right: float, *, colour: str
) -> str:
    """Draw a line between two points, percentages."""
    start = f'x1="{_x(from_chance):.1f}" y1="{_y(from_right):.1f}"'
    end = f'x2="{_x(to_chance):.1f}" y2="{_y(to_right):.1f}"'
    return f'<line {start} {end} stroke="{colour}"/>'


def _text(x: float, y: float, text: str, *, anchor: str = "start", extra: str = "") -> str:
    """Write a text at pixels of the figure."""
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" {extra}>{text}</text>'


def _x(percentage: float) -> float:
    """Place a chance on the horizontal axis, pixels."""
    return _LEFT + _SIDE * (percentage - _LEAST) / (_MOST - _LEAST)


def _y(percentage: float) -> float:
    """Place a share on the vertical axis, pixels."""
    return _TOP + _SIDE * (_MOST - percentage) / (_MOST - _LEAST)
