"""Tennis and basketball courts of parks and schools: worn, in use, fenced, with other lines."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from research.scenes.site import WHITE, Site, jitter, pick
from research.scenes.truth import CourtKind
from research.scenes.world import Material, PlacedCourt, Rgb, corners_of

# Outer lines of a tennis court (ITF).
_TENNIS_M = (23.77, 10.97)
_SINGLES_HALF_M = 8.23 / 2
_SERVICE_M = 6.40
_SURFACES: tuple[Rgb, ...] = (
    (72, 116, 92), (158, 88, 66), (84, 110, 150), (70, 104, 128), (112, 114, 116), (150, 108, 84),
    (92, 136, 104),
)  # fmt: skip
_RING_STEPS = 24


class _Basketball(NamedTuple):
    """Dimensions in metres, outside the lines: FIBA's rules, and those of NBA and NCAA in feet."""

    length: float
    width: float
    key_length: float
    key_width: float
    arc: float
    arc_from_side: float


_BASKETBALL: dict[CourtKind, _Basketball] = {
    "basketball_fiba": _Basketball(
        28.0, 15.0, key_length=5.8, key_width=4.9, arc=6.75, arc_from_side=0.9
    ),
    "basketball_nba": _Basketball(
        28.65, 15.24, key_length=5.79, key_width=4.88, arc=7.24, arc_from_side=0.91
    ),
    "basketball_ncaa": _Basketball(
        28.65, 15.24, key_length=5.79, key_width=3.66, arc=6.75, arc_from_side=1.02
    ),
}
_KINDS: tuple[CourtKind, ...] = ("tennis", *_BASKETBALL)
_KIND_SHARES = (0.6, 0.2, 0.12, 0.08)
_BASKET_FROM_END_M = 1.575
_RING_M = 1.8


class Paint:
    """Painter of the lines of one game on one court."""

    def __init__(self, site: Site, rgb: Rgb, width: float, wear: float) -> None:
        self.site = site
        self.rgb = rgb
        self.width = width
        self.wear = wear

    def line(self, x0: float, y0: float, x1: float, y1: float, width: float | None = None) -> None:
        """Paint a line whose centre connects two points; worn lines consist of pieces."""
        width = width or self.width
        if self.wear <= 0:
            self.site.line(x0, y0, x1, y1, width, self.rgb)
            return
        pieces = max(int(math.hypot(x1 - x0, y1 - y0)), 1)
        ends = np.linspace(0, 1, pieces + 1)
        is_worn = self.site.rng.random(pieces) < self.wear
        dx = x1 - x0
        dy = y1 - y0
        for (a, b), worn in zip(pairwise(ends), is_worn, strict=True):
            if worn:
                continue
            start_x = x0 + a * dx
            start_y = y0 + a * dy
            end_x = x0 + b * dx
            end_y = y0 + b * dy
            self.site.line(start_x, start_y, end_x, end_y, width, self.rgb)

    def path(self, points: NDArray[np.float64]) -> None:
        """Paint a line through points."""
        for (x0, y0), (x1, y1) in pairwise(points):
            self.line(x0, y0, x1, y1)

    def outline(self, length: float, width: float) -> None:
        """Paint a rectangle of this size to the outside of its lines."""
        x = (length - self.width) / 2
        y = (width - self.width) / 2
        self.line(-x, -y, x, -y)
        self.line(-x, y, x, y)
        self.line(-x, -y, -x, y)
        self.line(x, -y, x, y)


def sports_ground(site: Site, width: float, depth: float) -> None:
    """Lay out courts in rows on one or more slabs, with grass, trees and benches around."""
    rng = site.rng
    palette = site.palette
    site.rect((0, 0, width, depth), jitter(rng, palette.lawn, 6), Material.LAWN)
    y = rng.uniform(3, 8)
    while y + 36 < depth:
        x = rng.uniform(3, 10)
        surface = jitter(rng, pick(rng, _SURFACES), 8)
        inner = surface
        if rng.random() < 0.6:
            inner = jitter(rng, pick(rng, _SURFACES), 6)
        kind = _KINDS[int(rng.choice(len(_KINDS), p=_KIND_SHARES))]
        broad = rng.uniform(16.5, 19) if kind == "tennis" else rng.uniform(18.5, 21)
        wear = float(rng.choice([0.0, 0.0, 0.05, 0.15, 0.3]))
        while x + broad < width - 3:
            _slab(site.at(x + broad / 2, y + 17.5, math.pi / 2), broad, surface)
            place_court(site.at(x + broad / 2, y + 17.5, math.pi / 2), kind, inner=inner, wear=wear)
            x += broad + (0.0 if rng.random() < 0.6 else rng.uniform(2, 25))
            if rng.random() < 0.15:
                x += 20
        y += 36 + rng.uniform(2, 20)
    site.grove((1, 1, width - 1, depth - 1), 0.008 * palette.greenery)


def _slab(site: Site, broad: float, surface: Rgb) -> None:
    """Add the surfaced enclosure, 35 m long, with its fence."""
    rng = site.rng
    half_x = 17.5
    half_y = broad / 2
    slab = (-half_x, -half_y, half_x, half_y)
    site.rect(slab, surface, Material.COURT)
    site.target("sports-court", corners_of(slab))
    site.kept_free.append((site.frame, slab))
    for _ in range(rng.integers(0, 5)):
        site.crack(
            rng.uniform(-16, 16),
            rng.uniform(-half_y, half_y),
            length=rng.uniform(4, 16),
            angle=rng.uniform(0, 6.3),
            level=112,
        )
    if rng.random() < 0.6:  # little more than the fence's foot and shadow is visible
        fence: Rgb = (70, 78, 74)
        for x in (-half_x, half_x):
            site.box((x - 0.05, -half_y, x + 0.05, half_y), rng.uniform(0.3, 1.2), fence)
    if rng.random() < 0.5:
        for x in (-half_x + 0.5, half_x - 0.5):
            site.pole(x, -half_y + 0.3, rng.uniform(6, 10))


def place_court(site: Site, kind: CourtKind, inner: Rgb, wear: float) -> None:
    """Paint one court of exact size around the origin, long axis along x, with objects on it."""
    rng = site.rng
    length, width = _TENNIS_M if kind == "tennis" else _BASKETBALL[kind][:2]
    site.rect((-length / 2, -width / 2, length / 2, width / 2), inner, Material.COURT)
    if rng.random() < 0.3:  # damp or worn
        site.blob(
            rng.uniform(-10, 10),
            rng.uniform(-4, 4),
            rng.uniform(1, 5),
            rng.uniform(1, 3),
            inner,
            Material.COURT,
        )
        stain = (-2, -3, rng.uniform(0, 8), 3)
        site.stain_rect(stain, int(rng.integers(112, 142)))
    if rng.random() < 0.2:
        _other_game(site)
    tone = rng.uniform(0.35, 1.0)  # remaining whiteness of the paint
    rgb = tuple(
        int(tone * white + (1 - tone) * ground) for white, ground in zip(WHITE, inner, strict=True)
    )
    paint = Paint(site, (rgb[0], rgb[1], rgb[2]), width=rng.uniform(0.05, 0.1), wear=wear)
    if kind == "tennis":
        _tennis(paint)
    else:
        _basketball(paint, _BASKETBALL[kind])
    for _ in range(rng.poisson(1.2)):
        x = rng.uniform(-length / 2, length / 2)
        y = rng.uniform(-width / 2, width / 2)
        site.disc(float(x), float(y), radius=0.28, height=1.7, rgb=jitter(rng, (150, 120, 110), 40))
    corners = site.frame.points(
        [
            (-length / 2, -width / 2),
            (length / 2, -width / 2),
            (length / 2, width / 2),
            (-length / 2, width / 2),
        ]
    )
    site.world.courts.append(PlacedCourt(kind, corners))


def _tennis(paint: Paint) -> None:
    length, width = _TENNIS_M
    half = length / 2
    line = paint.width
    paint.outline(length, width)
    inside = _SINGLES_HALF_M - line / 2
    service = _SERVICE_M - line / 2
    for y in (-inside, inside):
        paint.line(-half, y, half, y)
    for x in (-service, service):
        paint.line(x, -inside, x, inside)
    paint.line(-service, 0, service, 0)
    if paint.site.rng.random() < 0.9:
        net_end = width / 2 + 0.9
        paint.site.box((-0.05, -net_end, 0.05, net_end), 1.0, (60, 64, 62))


def _basketball(paint: Paint, court: _Basketball) -> None:
    line = paint.width
    paint.outline(court.length, court.width)
    half = court.length / 2
    side = court.width / 2
    paint.line(0, -side, 0, side)
    around = np.linspace(0, 2 * np.pi, _RING_STEPS + 1)
    ring = np.stack([np.cos(around), np.sin(around)], axis=1)
    paint.path(ring * (_RING_M - line / 2))
    key_y = court.key_width / 2 - line / 2
    free_throw = half - court.key_length + line / 2
    reach = court.arc - line / 2
    straight_y = side - court.arc_from_side - line / 2
    for end in (-1.0, 1.0):
        for y in (-key_y, key_y):
            paint.line(end * half, y, end * free_throw, y)
        paint.line(end * free_throw, -key_y, end * free_throw, key_y)
        ahead = ring[(ring[:, 0] <= 1e-9)] * (_RING_M - line / 2)
        ahead_x = end * (free_throw + ahead[:, 0])
        paint.path(np.stack([ahead_x, ahead[:, 1]], axis=1))
        turn = math.asin(min(1.0, straight_y / reach))
        angles = np.linspace(-turn, turn, _RING_STEPS)
        basket = half - _BASKET_FROM_END_M
        arc_x = end * (basket - reach * np.cos(angles))
        arc_y = reach * np.sin(angles)
        arc = np.stack([arc_x, arc_y], axis=1)
        for x, y in (arc[0], arc[-1]):
            paint.line(end * half, y, x, y)
        paint.path(arc)
        board_x = end * half
        paint.site.box((board_x - 0.6, -0.9, board_x + 0.6, 0.9), 3.0, (110, 110, 112))


def _other_game(site: Site) -> None:
    """Paint lines of pickleball or volleyball in another colour."""
    rng = site.rng
    yellow_blue_red: tuple[Rgb, ...] = ((206, 190, 80), (90, 130, 190), (190, 90, 80))
    rgb = pick(rng, yellow_blue_red)
    paint = Paint(site, rgb, width=0.05, wear=0.0)
    length, width = (13.41, 6.10) if rng.random() < 0.6 else (18.0, 9.0)
    position = float(rng.choice([0.0, 0.0, 3.0]))
    shifted = Paint(site.at(position, 0.0), rgb, width=0.05, wear=0.0)
    shifted.outline(length, width)
    cross = 2.13 if width < 9 else 3.0
    for x in (-cross, cross):
        shifted.line(x, -width / 2, x, width / 2)
    if width < 9:
        for end in (-1, 1):
            shifted.line(end * cross, 0, end * length / 2, 0)
    else:
        paint.line(position, -width / 2, position, width / 2)
