"""Football pitches: full-size ones by the Laws of the Game, and smaller ones for children."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from research.scenes.site import jitter
from research.scenes.sports import Paint
from research.scenes.world import Material, PlacedCourt, Rgb

if TYPE_CHECKING:
    from research.scenes.site import Site
    from research.scenes.truth import CourtKind

_TURF: tuple[Rgb, ...] = ((74, 108, 62), (92, 118, 72), (64, 98, 66), (122, 126, 88), (56, 104, 74))
_PAINT: Rgb = (226, 228, 220)
_EDGE_M = 8.0  # of grass around a pitch
_ARC_STEPS = 24
_SMALL_SHARE = 0.25  # of pitches that are for children
_MOW_M = 5.5  # width of a mown band


class _Pitch(NamedTuple):
    """Dimensions in metres, outside the lines."""

    length: float
    width: float
    penalty_width: float
    penalty_depth: float
    goal_width: float
    goal_depth: float
    spot: float
    radius: float


_FULL = _Pitch(105.0, 68.0, 40.32, 16.5, 18.32, 5.5, 11.0, 9.15)  # IFAB, law 1
_SMALL = _Pitch(73.15, 45.72, 32.0, 13.0, 14.6, 4.6, 8.2, 6.4)  # The FA, 9 v 9: 80 x 50 yd


def pitch_ground(site: Site, width: float, depth: float) -> None:
    """Lay out football pitches in rows on grass, with trees around them."""
    rng = site.rng
    site.rect((0, 0, width, depth), jitter(rng, site.palette.lawn, 6), Material.LAWN)
    y = rng.uniform(_EDGE_M, 2 * _EDGE_M)
    while y + _FULL.width + _EDGE_M < depth:
        x = rng.uniform(_EDGE_M, 2 * _EDGE_M)
        while x + _FULL.length + _EDGE_M < width:
            place_pitch(site.at(x + _FULL.length / 2, y + _FULL.width / 2), small=rng.random() < _SMALL_SHARE)
            x += _FULL.length + rng.uniform(_EDGE_M, 3 * _EDGE_M)
        y += _FULL.width + rng.uniform(_EDGE_M, 2 * _EDGE_M)
    site.grove((1, 1, width - 1, depth - 1), 0.004 * site.palette.greenery)


def place_pitch(site: Site, *, small: bool = False) -> None:
    """Paint one pitch around the origin, with its long axis along x, and people on it."""
    rng, pitch = site.rng, _SMALL if small else _FULL
    half, side = pitch.length / 2, pitch.width / 2
    turf = jitter(rng, _TURF[int(rng.integers(len(_TURF)))], 6)
    ground = (-half - _EDGE_M / 2, -side - _EDGE_M / 2, half + _EDGE_M / 2, side + _EDGE_M / 2)
    site.rect(ground, turf, Material.LAWN)
    site.kept_free.append((site.frame, ground))
    if rng.random() < 0.6:
        for index, x in enumerate(np.arange(-half, half, _MOW_M)):
            site.stain_rect((float(x), -side, min(float(x) + _MOW_M, half), side), 132 if index % 2 else 124)
    for end in (-1, 1):  # worn goal mouths
        site.blob(end * (half - 1.5), 0, 1.5, 4.0, jitter(rng, site.palette.soil, 8), Material.SOIL)
    tone = float(rng.uniform(0.35, 1.0))
    red, green, blue = (int(tone * white + (1 - tone) * grass) for white, grass in zip(_PAINT, turf, strict=True))
    paint = Paint(site, (red, green, blue), float(rng.uniform(0.1, 0.12)), float(rng.choice([0.0, 0.0, 0.1, 0.2])))
    _paint(paint, pitch)
    for _ in range(int(rng.poisson(6))):
        x, y = rng.uniform(-half, half), rng.uniform(-side, side)
        site.disc(float(x), float(y), 0.28, 1.7, jitter(rng, (150, 120, 110), 40))
    kind: CourtKind = "football_small" if small else "football"
    corners = site.frame.points([(-half, -side), (half, -side), (half, side), (-half, side)])
    site.world.courts.append(PlacedCourt(kind, corners))


def _paint(paint: Paint, pitch: _Pitch) -> None:
    inset = paint.width / 2
    half, side = pitch.length / 2, pitch.width / 2
    paint.outline(pitch.length, pitch.width)
    paint.line(0, -side, 0, side)
    around = np.linspace(0, 2 * np.pi, 2 * _ARC_STEPS + 1)
    paint.path((pitch.radius - inset) * np.stack([np.cos(around), np.sin(around)], axis=1))
    for end in (-1.0, 1.0):
        for width, depth in ((pitch.penalty_width, pitch.penalty_depth), (pitch.goal_width, pitch.goal_depth)):
            x, y = end * (half - depth + inset), width / 2 - inset
            paint.line(x, -y, x, y)
            for edge in (-y, y):
                paint.line(end * (half - inset), edge, x, edge)
        turn = math.acos((pitch.penalty_depth - pitch.spot) / pitch.radius)
        angles = np.linspace(-turn, turn, _ARC_STEPS)
        reach = pitch.radius - inset
        paint.path(np.stack([end * (half - pitch.spot - reach * np.cos(angles)), reach * np.sin(angles)], axis=1))
