"""Track of a flight as SVG: positions of the photographs, their scales and the supporting rulers."""

from __future__ import annotations

import math
from html import escape
from pathlib import PurePath
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.records.digits import significant

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor_flight.records import FlightEstimate, FlightPhotograph

_WIDTH, _HEIGHT, _MARGIN, _LEGEND = 860, 520, 46, 88  # pixels of a panel
_RADIUS = 8.0
_MOST_LABELS, _SHORTEST_LABEL = 45, 3
_SCALE_COLOURS = ((68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37))  # viridis, fine to coarse
_RINGS = {  # Okabe and Ito's colours, told apart with every kind of colour blindness
    "vehicles of its own": "#0072b2",
    "other rulers of its own": "#009e73",
    "positions": "#e69f00",
    "another photograph": "#7a7a7a",
    "nothing": "#d55e00",
}


class _Panel(NamedTuple):
    """Photographs in one coordinate frame."""

    title: str
    photographs: list[FlightPhotograph]


def draw_tracks(record: FlightEstimate) -> str:
    """Draw a panel for each coordinate frame: one for positions by metadata, one for each component without them.

    The colour of a disc is the scale, its rim the support of the scale. Lines are overlaps, dashed if they were
    dropped.

    Args:
        record: record of a flight.

    Returns:
        SVG elements, one per panel; empty if no photograph has a position.
    """
    scales = [each.gsd_m_per_px for each in record.photographs if each.gsd_m_per_px is not None]
    bounds = (min(scales), max(scales)) if scales else (1.0, 1.0)
    return "\n".join(_draw(panel, record, bounds) for panel in _panels(record))


def _panels(record: FlightEstimate) -> list[_Panel]:
    placed = [each for each in record.photographs if each.placed_by == "positions"]
    panels = [_Panel("Where the photographs were taken, by their metadata", placed)] if placed else []
    for component in record.components:
        members = [
            each for each in record.photographs if each.component == component.number and each.placed_by == "overlaps"
        ]
        if members:
            panels.append(_Panel(f"Component {component.number}: photographs placed by their overlaps", members))
    return panels


def _draw(panel: _Panel, record: FlightEstimate, bounds: tuple[float, float]) -> str:
    east = [each.east_m or 0.0 for each in panel.photographs]
    north = [each.north_m or 0.0 for each in panel.photographs]
    across, down = max(east) - min(east), max(north) - min(north)
    factor = min((_WIDTH - 2 * _MARGIN) / max(across, 1e-9), (_HEIGHT - 2 * _MARGIN) / max(down, 1e-9), 1e4)
    left = (_WIDTH - factor * across) / 2
    top = (_HEIGHT - factor * down) / 2
    at = {
        each.photograph: (left + factor * (x - min(east)), top + factor * (max(north) - y))
        for each, x, y in zip(panel.photographs, east, north, strict=True)
    }
    parts = [
        f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT + _LEGEND}" role="img" aria-label="{escape(panel.title)}">',
        f'<text x="10" y="20" class="title">{escape(panel.title)}</text>',
    ]
    for link in record.links:
        if link.first in at and link.second in at:
            kind = "dropped" if link.dropped else "link"
            (x1, y1), (x2, y2) = at[link.first], at[link.second]
            parts.append(f'<line class="{kind}" x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"/>')
    parts += [_disc(each, at[each.photograph], bounds) for each in panel.photographs]
    if len(panel.photographs) <= _MOST_LABELS:
        names = _short_names([PurePath(each.photograph).stem for each in panel.photographs])
        parts += [_label(name, at[each.photograph]) for each, name in zip(panel.photographs, names, strict=True)]
    return "\n".join([*parts, _bar(factor), *_legend(bounds), "</svg>"])


def _disc(each: FlightPhotograph, at: tuple[float, float], bounds: tuple[float, float]) -> str:
    scale = "no scale" if each.gsd_m_per_px is None else f"{significant(each.gsd_m_per_px, 4)} m/px"
    tooltip = f"{each.photograph}: {scale}, {each.status}, supported by {_supporters(each)}"
    fill = "none" if each.gsd_m_per_px is None else _colour(each.gsd_m_per_px, bounds)
    return (
        f'<circle cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="{_RADIUS}" fill="{fill}" '
        f'stroke="{_RINGS[_supporters(each)]}" stroke-width="3.5"><title>{escape(tooltip)}</title></circle>'
    )


def _label(name: str, at: tuple[float, float]) -> str:
    return f'<text class="name" x="{at[0] + _RADIUS + 4:.1f}" y="{at[1] + 3.5:.1f}">{escape(name)}</text>'


def _short_names(stems: Sequence[str]) -> list[str]:
    """Shorten names to the shortest distinct ends, without their common suffix."""
    shared = 0
    while len(stems) > 1 and shared < min(map(len, stems)) and len({stem[-shared - 1] for stem in stems}) == 1:
        shared += 1
    bare = [stem[: len(stem) - shared] or stem for stem in stems]
    for length in range(_SHORTEST_LABEL, max(map(len, bare))):
        ends = [stem[-length:] for stem in bare]
        if len(set(ends)) == len(set(bare)):
            return ends
    return bare


def _supporters(each: FlightPhotograph) -> str:
    if not each.supported_by or each.gsd_m_per_px is None:
        return "nothing"
    first = each.supported_by[0]
    if first.photograph != each.photograph:
        return "another photograph"
    if first.ruler in ("vehicles", "positions"):
        return "positions" if first.ruler == "positions" else "vehicles of its own"
    return "other rulers of its own"


def _colour(gsd_m_per_px: float, bounds: tuple[float, float]) -> str:
    low, high = bounds
    share = 0.5 if high <= low else math.log(gsd_m_per_px / low) / math.log(high / low)
    place = min(max(share, 0.0), 1.0) * (len(_SCALE_COLOURS) - 1)
    first = min(int(place), len(_SCALE_COLOURS) - 2)
    mixed = (
        round(a + (b - a) * (place - first))
        for a, b in zip(_SCALE_COLOURS[first], _SCALE_COLOURS[first + 1], strict=True)
    )
    return "#" + "".join(f"{each:02x}" for each in mixed)


def _bar(px_per_m: float) -> str:
    """Draw a bar of round length at the lower right."""
    metres = 10.0 ** math.floor(math.log10(160 / px_per_m))
    metres *= next(step for step in (5, 2, 1) if step * metres * px_per_m <= 160)
    right, bottom = _WIDTH - 14, _HEIGHT + 6
    start = right - metres * px_per_m
    return (
        f'<line class="bar" x1="{start:.1f}" y1="{bottom}" x2="{right}" y2="{bottom}"/>'
        f'<text class="name" x="{start:.1f}" y="{bottom - 7}">{metres:g} m</text>'
    )


def _legend(bounds: tuple[float, float]) -> Sequence[str]:
    stops = "".join(
        f'<stop offset="{100 * k / (len(_SCALE_COLOURS) - 1):g}%" stop-color="rgb{colour}"/>'
        for k, colour in enumerate(_SCALE_COLOURS)
    )
    row = _HEIGHT + 24
    parts = [
        f'<defs><linearGradient id="scale">{stops}</linearGradient></defs>',
        f'<rect x="14" y="{row}" width="180" height="12" fill="url(#scale)"/>',
        f'<text class="name" x="14" y="{row + 27}">{significant(bounds[0])} m/px</text>',
        f'<text class="name" x="194" y="{row + 27}" text-anchor="end">{significant(bounds[1])} m/px</text>',
    ]
    for number, (name, colour) in enumerate(_RINGS.items()):
        x, y = 240 + 210 * (number % 3), row + 6 + 24 * (number // 3)
        parts.append(f'<circle cx="{x}" cy="{y}" r="6" fill="none" stroke="{colour}" stroke-width="3.5"/>')
        parts.append(f'<text class="name" x="{x + 13}" y="{y + 4}">{name}</text>')
    return parts
