"""Street grid: a region split by smaller and smaller streets, with markings and traffic."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from research.scenes.site import Site, jitter
from research.scenes.world import Material, Rect


@dataclass(frozen=True)
class StreetPlan:
    """Sizes of a layout's streets and blocks, and their traffic."""

    block_size: tuple[float, float]
    """Largest block that is not split; drawn for each block."""
    carriages: tuple[float, ...]
    """Width of the carriageway by depth of the split; the last value holds for deeper splits."""
    pavement: float
    parking: float
    """Share of streets with cars along the kerb, among streets wide enough."""
    traffic: float
    """Driving cars per 100 m and lane."""
    marked: bool


@dataclass(eq=False)
class Street:
    """Straight street; in its own frame its axis runs along +x from 0 to ``length``."""

    x: float
    y: float
    vertical: bool
    length: float
    carriage: float
    pavement: float
    depth: int
    parking: bool
    junctions: list[tuple[float, float, int]] = field(default_factory=list)
    """Streets that end here: position along the street, half width, side (+1: larger y)."""

    @property
    def half(self) -> float:
        """Distance from the axis to the edge of the blocks."""
        return self.carriage / 2 + self.pavement


@dataclass(frozen=True)
class Block:
    """Rectangle between streets, and the streets at its left, top, right and bottom side."""

    rect: Rect
    streets: tuple[Street | None, Street | None, Street | None, Street | None]


def divide(
    site: Site,
    rect: Rect,
    plan: StreetPlan,
    sides: tuple[Street | None, ...] = (None,) * 4,
    depth: int = 0,
) -> tuple[list[Street], list[Block]]:
    """Split a rectangle into blocks with streets between them."""
    rng = site.rng
    x0, y0, x1, y1 = rect
    width = x1 - x0
    height = y1 - y0
    limit = rng.uniform(*plan.block_size)
    left, top, right, bottom = sides
    if max(width, height) < limit or min(width, height) < 30:
        return [], [Block(rect, (left, top, right, bottom))]
    vertical = width > height * rng.uniform(0.8, 1.25)
    carriage = plan.carriages[min(depth, len(plan.carriages) - 1)] * rng.uniform(0.92, 1.1)
    parking = carriage >= 7.5 and rng.random() < plan.parking
    pavement = plan.pavement * rng.uniform(0.8, 1.3)
    share = rng.uniform(0.35, 0.65)
    if vertical:
        x = x0 + width * share
        y = y0
        length = height
        ends = (top, bottom)
    else:
        x = x0
        y = y0 + height * share
        length = width
        ends = (left, right)
    street = Street(
        x,
        y,
        vertical=vertical,
        length=length,
        carriage=carriage,
        pavement=pavement,
        depth=depth,
        parking=bool(parking),
    )
    for other in ends:
        if other is None:
            continue
        side = 1 if other in (top, left) else -1
        along = street.x - other.x
        if other.vertical:
            # A vertical street's y axis points to -x, and sides are given in the street's frame.
            side = -side
            along = street.y - other.y
        other.junctions.append((along, street.half, side))
    half = street.half
    streets = [street]
    blocks = []
    halves: tuple[tuple[Rect, tuple[Street | None, ...]], ...]
    if vertical:
        halves = (
            ((x0, y0, street.x - half, y1), (left, top, street, bottom)),
            ((street.x + half, y0, x1, y1), (street, top, right, bottom)),
        )
    else:
        halves = (
            ((x0, y0, x1, street.y - half), (left, top, right, street)),
            ((x0, street.y + half, x1, y1), (left, street, right, bottom)),
        )
    for part, part_sides in halves:
        part_streets, part_blocks = divide(site, part, plan=plan, sides=part_sides, depth=depth + 1)
        streets += part_streets
        blocks += part_blocks
    return streets, blocks


def build_street(site: Site, street: Street, plan: StreetPlan, layer: str) -> None:
    """Draw one layer of a street: ``base``, ``carriage`` or ``marks``.

    Junctions are joined by drawing one layer of all streets before the next one.
    """
    own = site.at(street.x, street.y, math.pi / 2 if street.vertical else 0.0)
    half = street.carriage / 2
    length = street.length
    if layer == "base":
        if street.pavement > 0:
            own.rect((0, -street.half, length, street.half), site.palette.paving, Material.PAVING)
            kerb = jitter(site.rng, (188, 186, 180), 4)
            own.rect(
                (-street.pavement, -half - 0.18, length + street.pavement, half + 0.18),
                kerb,
                Material.PAVING,
            )
        else:
            own.rect((0, -half - 1.2, length, half + 1.2), site.palette.meadow, Material.MEADOW)
            own.rect(
                (-0.4, -half - 0.35, length + 0.4, half + 0.35),
                site.palette.gravel,
                Material.GRAVEL,
            )
    elif layer == "carriage":
        _carriageway(own, street)
    else:
        _markings(own, street, plan)
        _wear(own, street)
        _furniture(own, street)
        _traffic(own, street, plan)


def _carriageway(own: Site, street: Street) -> None:
    half = street.carriage / 2
    length = street.length
    reach = street.pavement + 0.6
    rgb = jitter(own.rng, own.palette.asphalt, 3, 0.07)
    own.rect((-reach, -half, length + reach, half), rgb, Material.ASPHALT)
    for along, other_half, side in street.junctions:
        edge = side * half
        for direction in (-1, 1):
            corner = along + direction * (other_half - street.pavement)
            radius = min(3.0, street.pavement + 2.0)
            curve = []
            for angle in np.linspace(0, np.pi / 2, 6):
                x = corner + direction * radius * (1 - math.cos(angle))
                y = edge + side * radius * (1 - math.sin(angle))
                curve.append((x, y))
            own.polygon([(corner, edge), *curve], rgb, Material.ASPHALT)


def _free(
    street: Street, start: float, stop: float, margin: float, side: int | None = None
) -> list[tuple[float, float]]:
    """Compute the stretches between start and stop without a junction on that side, or on any."""
    stretches = []
    position = start
    for along, half, where in sorted(street.junctions):
        if side is not None and where != side:
            continue
        if along - half - margin > position:
            stretches.append((position, along - half - margin))
        position = max(position, along + half + margin)
    if stop > position:
        stretches.append((position, stop))
    return stretches


def _markings(own: Site, street: Street, plan: StreetPlan) -> None:
    rng = own.rng
    half = street.carriage / 2
    length = street.length
    if not plan.marked and street.depth > 0:
        return
    if street.carriage < 5.5 or length < 25:
        return
    dash, gap = (3.0, 4.5) if rng.random() < 0.6 else (1.5, 3.0)
    offsets = [0.0]
    if street.carriage >= 12.5:
        offsets = [-3.3, 0.0, 3.3]
    for offset in offsets:
        solid = len(offsets) > 1 and offset == 0.0
        for start, stop in _free(street, 9, stop=length - 9, margin=1):
            if solid:
                own.line(start, offset, stop, offset, 0.15)
                continue
            for position in np.arange(start, stop - dash, dash + gap):
                own.line(position, offset, position + dash, offset, 0.12)
    if street.parking:
        lane = _lane(own) - 0.2
        for side in (-1, 1):
            y = side * (half - lane)
            for start, stop in _free(street, 8, stop=length - 8, margin=5, side=side):
                own.line(start, y, max(stop, start + 1), y, 0.1)
    zebra = rng.random() < 0.55
    for end in (0, 1):
        direction = 1 - 2 * end
        edge = end * length
        if zebra:
            for y in np.arange(-half + 0.5, half - 0.6, 1.0):
                x = edge + direction * 1.5
                own.line(x, y + 0.25, x + direction * 3.0, y + 0.25, 0.5)
        if len(offsets) > 1 or rng.random() < 0.5:
            x = edge + direction * (6.0 if zebra else 2.0)
            own.line(x, -direction * 0.2, x, -direction * (half - 0.3), 0.4)


def _wear(own: Site, street: Street) -> None:
    """Add wheel tracks, patches, cracks and manhole covers."""
    rng = own.rng
    half = street.carriage / 2
    length = street.length
    driving_half = half - _lane(own) if street.parking else half
    lane = min(driving_half, 3.4)
    for side in (-1, 1):
        for track in (0.28, 0.72):
            y = side * lane * track
            own.stain_rect((0, y - 0.3, length, y + 0.3), int(rng.integers(119, 127)))
    for _ in range(rng.poisson(length / 35)):
        x = rng.uniform(0, length)
        y = rng.uniform(-half, half - 1)
        size = (rng.uniform(1, 14), rng.uniform(0.6, 2.6))
        patch = (x, y, x + size[0], min(y + size[1], half))
        own.stain_rect(patch, int(rng.choice([108, 114, 119, 136, 141])))
    for _ in range(rng.poisson(length / 14)):
        heading = rng.choice([0.0, 0.0, math.pi / 2]) + rng.normal(0, 0.15)
        span = rng.uniform(2, 6) if abs(math.sin(heading)) > 0.5 else rng.uniform(4, 20)
        own.crack(
            rng.uniform(0, length),
            rng.uniform(-half * 0.7, half * 0.7),
            length=span,
            angle=heading,
            level=int(rng.integers(96, 116)),
        )
    for _ in range(rng.poisson(length / 30)):
        x = rng.uniform(0, length)
        y = rng.uniform(-half + 0.5, half - 0.5)
        angles = np.linspace(0, 2 * np.pi, 10, endpoint=False)
        circle_x = x + 0.33 * np.cos(angles)
        circle_y = y + 0.33 * np.sin(angles)
        own.stain(np.stack([circle_x, circle_y], axis=1), 84)


def _furniture(own: Site, street: Street) -> None:
    """Add trees and lamp posts on the pavement."""
    rng = own.rng
    if street.pavement < 1.2:
        return
    planted = rng.random() < 0.4
    radius = rng.uniform(1.2, 2.6)
    for side in (-1, 1):
        y = side * (street.half - 0.75)
        for start, stop in _free(street, 6, stop=street.length - 6, margin=3, side=side):
            if planted:
                for x in np.arange(start + rng.uniform(0, 6), stop, rng.uniform(7, 11)):
                    if rng.random() >= 0.85:
                        continue
                    pit = (x - 0.6, y - 0.6, x + 0.6, y + 0.6)
                    own.rect(pit, own.palette.soil, Material.SOIL)
                    own.tree(float(x), y, float(radius * rng.uniform(0.75, 1.2)))
            # Lamp posts stand on one side only.
            if side > 0:
                for x in np.arange(start + rng.uniform(2, 20), stop, 28):
                    own.pole(float(x), side * (street.carriage / 2 + 0.4), 7.5)


def _lane(own: Site) -> float:
    """Compute the width of the carriageway that cars at the kerb take."""
    return own.fleet.max_width_m + 0.35


def _traffic(own: Site, street: Street, plan: StreetPlan) -> None:
    """Add cars at the kerb and vehicles that drive."""
    fleet = own.fleet
    free_half = street.carriage / 2
    if street.parking:
        _parked_cars(own, street)
        free_half -= _lane(own)
    if free_half < fleet.max_width_m / 2 + 0.25:
        return
    sides: tuple[int, ...] = (-1, 1)
    if free_half < 1.2 * fleet.max_width_m:
        # Too narrow for two cars: one lane, one way.
        sides = (1,)
        lanes = [0.0]
    elif street.carriage >= 12.5 and not street.parking:
        lanes = [1.65, 4.95]
    else:
        lanes = [free_half / 2]
    # Wide streets, which split the region first, have the most traffic.
    factor = {0: 1.6, 1: 1.0}.get(street.depth, 0.45)
    density = plan.traffic / 100 * factor
    for side in sides:
        for lane in lanes:
            _driving(own, street, side * lane, density=density, free_half=free_half)


def _parked_cars(own: Site, street: Street) -> None:
    rng = own.rng
    fleet = own.fleet
    filled = rng.uniform(0.35, 0.97)
    for side in (-1, 1):
        heading = 0.0 if side > 0 else math.pi
        for start, stop in _free(street, 8, stop=street.length - 8, margin=5.5, side=side):
            position = start
            # Whether a car fits must not depend on its length: that would favour short ones.
            while position + fleet.max_length_m < stop:
                model = fleet.small()
                if rng.random() < filled:
                    # Some cars face the other way.
                    reversed_by = math.pi if rng.random() < 0.12 else 0
                    turn = float(np.clip(rng.normal(0, 0.015), -0.04, 0.04))
                    from_kerb = min(abs(rng.normal(0, 0.05)), 0.1)
                    y = side * (street.carriage / 2 - 0.2 - model.width_m / 2 - from_kerb)
                    x = position + model.length_m / 2
                    own.vehicle(model, x, y=y, angle=heading + reversed_by + turn)
                position += model.length_m + 0.5 + rng.exponential(0.45)


def _driving(own: Site, street: Street, lane: float, density: float, free_half: float) -> None:
    """Add the vehicles of one lane; ``lane`` is its distance from the axis, signed by side."""
    rng = own.rng
    heading = math.pi if lane < 0 else 0.0
    position = 9 + rng.exponential(1 / density)
    while position + 17 < street.length - 5:
        offset = 0.0
        turn = 0.0
        if free_half > 3.1 and rng.random() < 0.10:
            # Large vehicles keep to the middle of the lane; the number is drawn all the same.
            model = own.fleet.large("truck", "bus", "semitrailer")
            rng.normal(0, 0.08)
        else:
            model = own.fleet.small()
            offset = float(np.clip(rng.normal(0, 0.08), -0.15, 0.15))
            turn = float(np.clip(rng.normal(0, 0.008), -0.02, 0.02))
        x = position + model.length_m / 2
        own.vehicle(model, x, y=lane + offset, angle=heading + turn)
        position += 17 + 2.5 + rng.exponential(1 / density)
