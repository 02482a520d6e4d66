"""Builders of the blocks between streets, by name."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from research.scenes.car_parks import car_park, halls
from research.scenes.country import farm, field, meadow, orchard, vineyard, wood
from research.scenes.homes import flats, houses, town
from research.scenes.site import Site, jitter, pick
from research.scenes.sports import sports_ground
from research.scenes.world import Material, corners_of

Filler = Callable[[Site, float, float], None]
"""Function that builds from (0, 0) to (width, depth) in the site's frame."""


def park(site: Site, width: float, depth: float) -> None:
    """Build a park: lawn, paths, trees, perhaps courts."""
    rng = site.rng
    palette = site.palette
    lawn = jitter(rng, palette.lawn, 6)
    material = Material.MEADOW if rng.random() < 0.5 else Material.LAWN
    site.rect((0, 0, width, depth), lawn, material)
    path = jitter(rng, palette.gravel, 6)
    for _ in range(2):
        a, b = rng.uniform(0.1, 0.9, 2)
        xs = np.linspace(0, 1, 14)
        ys = a + (b - a) * xs + 0.06 * np.sin(xs * 6 + rng.uniform(0, 6))
        upper_y = np.clip(ys * depth + 1.1, 0, depth)
        lower_y = np.clip(ys * depth - 1.1, 0, depth)
        upper = np.stack([xs * width, upper_y], axis=1)
        lower = np.stack([xs * width, lower_y], axis=1)
        site.polygon(np.vstack([upper, lower[::-1]]), path, Material.GRAVEL)
    taken = 0.0
    if width > 46 and depth > 26 and rng.random() < 0.75:
        taken = courts(site.at(4, 4), width - 8, depth - 8) + 4
    site.grove((taken + 3 if taken else 1, 1, width - 1, depth - 1), 0.012 * palette.greenery)
    for _ in range(rng.poisson(width * depth / 200)):
        site.bush(rng.uniform(taken, width), rng.uniform(0, depth))


# Colours of the slab of a court, and of its playing area.
_SURFACE_RGB = ((72, 116, 92), (158, 88, 66), (84, 110, 150), (70, 104, 128))
_INNER_RGB = ((158, 92, 70), (74, 120, 96), (76, 108, 156))


def courts(site: Site, width: float, depth: float) -> float:
    """Build tennis and basketball courts side by side; return the used width."""
    rng = site.rng
    x = 0.0
    surface = jitter(rng, pick(rng, _SURFACE_RGB), 8)
    inner = jitter(rng, pick(rng, (*_INNER_RGB, surface)), 6)
    for _ in range(rng.integers(1, 4)):
        tennis = rng.random() < 0.65
        long, broad = (34.0, 17.0) if tennis else (32.0, 19.0)
        if x + broad > width or long > depth + 4:
            break
        own = site.at(x, 0)
        long = min(long, depth)
        slab = (0, 0, broad, long)
        own.rect(slab, surface, Material.COURT)
        own.target("sports-court", corners_of(slab))
        site.kept_free.append((own.frame, slab))
        court_w, court_l = (10.97, 23.77) if tennis else (15.0, 28.0)
        court_l = min(court_l, long - 1)
        cx0 = (broad - court_w) / 2
        cy0 = (long - court_l) / 2
        cx1 = cx0 + court_w
        cy1 = cy0 + court_l
        own.rect((cx0, cy0, cx1, cy1), inner, Material.COURT)
        for a, b, c, d in (
            (cx0, cy0, cx1, cy0),
            (cx0, cy1, cx1, cy1),
            (cx0, cy0, cx0, cy1),
            (cx1, cy0, cx1, cy1),
        ):
            own.line(a, b, c, d, 0.09)
        middle = (cy0 + cy1) / 2
        if tennis:
            for dx in (1.37, court_w - 1.37):
                own.line(cx0 + dx, cy0, cx0 + dx, cy1, 0.07)
            for dy in (-6.4, 6.4):
                own.line(cx0 + 1.37, middle + dy, cx1 - 1.37, middle + dy, 0.07)
            own.line(broad / 2, middle - 6.4, broad / 2, middle + 6.4, 0.07)
            own.box((cx0 - 0.9, middle - 0.05, cx1 + 0.9, middle + 0.05), 1.0, (60, 64, 62))
        else:
            own.line(cx0, middle, cx1, middle, 0.09)
            for edge, direction in ((cy0, 1), (cy1, -1)):
                own.line(broad / 2 - 2.45, edge, broad / 2 - 2.45, edge + direction * 5.8, 0.09)
                own.line(broad / 2 + 2.45, edge, broad / 2 + 2.45, edge + direction * 5.8, 0.09)
                own.line(
                    broad / 2 - 2.45,
                    edge + direction * 5.8,
                    broad / 2 + 2.45,
                    edge + direction * 5.8,
                    0.09,
                )
        x += broad + rng.uniform(0.5, 4)
    return x


FILLERS: dict[str, Filler] = {
    "car_park": car_park,
    "halls": halls,
    "houses": houses,
    "flats": flats,
    "town": town,
    "park": park,
    "sports_ground": sports_ground,
    "field": field,
    "vineyard": vineyard,
    "orchard": orchard,
    "meadow": meadow,
    "wood": wood,
    "farm": farm,
}
