"""Layout of a world: streets first, then the blocks between them."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.random import Generator

from research.scenes.blocks import FILLERS
from research.scenes.fleet import Fleet
from research.scenes.site import Palette, Site
from research.scenes.streets import Block, StreetPlan, build_street, divide
from research.scenes.truth import Layout
from research.scenes.world import Frame, Material, World


@dataclass(frozen=True)
class _Plan:
    streets: StreetPlan
    fillers: dict[str, float]


_PLANS: dict[Layout, _Plan] = {
    "urban": _Plan(
        StreetPlan(
            (55, 110), (13.5, 9.0, 8.2, 6.5), pavement=2.0, parking=0.75, traffic=2.2, marked=True
        ),
        {"houses": 0.46, "flats": 0.2, "town": 0.14, "park": 0.08, "car_park": 0.08, "halls": 0.04},
    ),
    "parking": _Plan(
        StreetPlan(
            (85, 150), (13.5, 8.0, 7.0), pavement=2.2, parking=0.2, traffic=2.0, marked=True
        ),
        {"car_park": 0.6, "halls": 0.3, "flats": 0.04, "park": 0.06},
    ),
    "countryside": _Plan(
        StreetPlan(
            (110, 200), (6.8, 5.6, 4.2), pavement=0.0, parking=0.0, traffic=1.3, marked=False
        ),
        {
            "field": 0.26,
            "vineyard": 0.14,
            "orchard": 0.08,
            "meadow": 0.14,
            "wood": 0.10,
            "farm": 0.20,
            "houses": 0.08,
        },
    ),
    "sports": _Plan(
        StreetPlan(
            (70, 130), (13.5, 8.0, 7.0), pavement=2.2, parking=0.5, traffic=2.0, marked=True
        ),
        {"sports_ground": 0.5, "park": 0.06, "houses": 0.2, "car_park": 0.16, "flats": 0.08},
    ),
}
# Margin around the view, from which objects can cast shadows into it.
_MARGIN_M = 45.0
_MIN_EXTENT_M = 150.0


def lay_out(rng: Generator, layout: Layout, width_m: float, height_m: float, fleet: Fleet) -> World:
    """Build a world that covers a view of this size and a margin around it.

    Small views are centred on a vehicle, if there is one.
    """
    plan = _PLANS[layout]
    extent = max(math.hypot(width_m, height_m), _MIN_EXTENT_M) + 2 * _MARGIN_M
    palette = Palette.draw(rng)
    turn = rng.uniform(0, 2 * math.pi)
    centre = Frame(width_m / 2, height_m / 2, turn)
    world = World()
    shift = rng.uniform(-0.2, 0.2, 2) * 60
    site = Site(
        world, centre.at(float(shift[0]), float(shift[1])), rng=rng, fleet=fleet, palette=palette
    )
    half = extent / 2 + 12
    site.rect((-half, -half, half, half), palette.meadow, Material.MEADOW)
    streets, blocks = divide(site, (-half, -half, half, half), plan.streets)
    names = list(plan.fillers)
    shares = np.array([plan.fillers[name] for name in names])
    for layer in ("base", "carriage"):
        for street in sorted(streets, key=lambda street: -street.depth):
            build_street(site, street, plan=plan.streets, layer=layer)
    for block, block_rng in zip(blocks, rng.spawn(len(blocks)), strict=True):
        name = names[int(block_rng.choice(len(names), p=shares / shares.sum()))]
        if _in_reach(site.frame, block, width=width_m, height=height_m):
            own_fleet = Fleet(fleet.mean_length_m, block_rng, fleet.kind)
            _fill(replace(site, rng=block_rng, fleet=own_fleet, kept_free=[]), block, name)
    for street in sorted(streets, key=lambda street: -street.depth):
        build_street(site, street, plan=plan.streets, layer="marks")
    return world


def _in_reach(frame: Frame, block: Block, width: float, height: float) -> bool:
    """Test whether a block is in the view or can cast a shadow into it."""
    x0, y0, x1, y1 = block.rect
    (centre,) = frame.points([((x0 + x1) / 2, (y0 + y1) / 2)])
    half_size = (width / 2, height / 2)
    outside = np.maximum(np.abs(centre - half_size) - half_size, 0)
    return bool(np.hypot(*outside) < math.hypot(x1 - x0, y1 - y0) / 2 + _MARGIN_M)


def _fill(site: Site, block: Block, name: str) -> None:
    """Build a block in a frame whose line y = 0 is its longest side on a street."""
    x0, y0, x1, y1 = block.rect
    width = x1 - x0
    height = y1 - y0
    left, top, right, bottom = block.streets
    sides = [
        (width, top, site.at(x0, y0), width, height),
        (width, bottom, site.at(x1, y1, math.pi), width, height),
        (height, left, site.at(x0, y1, -math.pi / 2), height, width),
        (height, right, site.at(x1, y0, math.pi / 2), height, width),
    ]
    _, _, own, along, deep = max(
        sides, key=lambda side: side[0] * (1 if side[1] is not None else 0.1)
    )
    if min(along, deep) < 12:
        name = "park"
    FILLERS[name](own, along, deep)
