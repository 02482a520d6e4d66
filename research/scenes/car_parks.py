"""Car parks, and halls with yards."""

from __future__ import annotations

import math

import numpy as np

from research.scenes.site import Site, flat_roof_rgb, jitter
from research.scenes.world import Material, Rect, Rgb, corners_of


def car_park(site: Site, width: float, depth: float) -> None:
    """Build a surface car park: rows of bays, aisles, islands with trees."""
    rng = site.rng
    tone = rng.uniform(0.85, 1.25)
    red, green, blue = (int(min(c * tone, 190)) for c in site.palette.asphalt)
    rgb: Rgb = (red, green, blue)
    site.rect((0, 0, width, depth), site.palette.lawn, Material.LAWN)
    lot = (0.6, 0.6, width - 0.6, depth - 0.6)
    site.rect(lot, rgb, Material.ASPHALT)
    site.target("parking-lot", corners_of(lot))
    for _ in range(rng.poisson(width * depth / 500)):
        site.crack(
            rng.uniform(0, width),
            rng.uniform(0, depth),
            length=rng.uniform(4, 20),
            angle=rng.choice([0, math.pi / 2]),
            level=112,
        )
    for _ in range(rng.poisson(width * depth / 900)):
        x = rng.uniform(0, width)
        y = rng.uniform(0, depth)
        w = rng.uniform(3, 18)
        d = rng.uniform(2, 8)
        site.stain_rect(
            (x, y, min(x + w, width), min(y + d, depth)), int(rng.choice([117, 121, 135, 140]))
        )
    if width >= depth:
        _rows(site, width, depth)
    else:
        _rows(site.at(width, 0, math.pi / 2), depth, width)


def _rows(site: Site, width: float, depth: float) -> None:
    rng = site.rng
    fleet = site.fleet
    slant = float(rng.choice([0.0, 0.0, 0.0, math.radians(25)]))
    bay = fleet.bay_length_m
    aisle = rng.uniform(5.8, 6.8) * (1 if slant == 0 else 0.75)
    row = bay * math.cos(slant) + fleet.bay_width_m * math.sin(slant)
    module = 2 * row + aisle
    filled = float(np.clip(rng.beta(2.2, 1.1), 0.15, 0.98))
    margin = 5.5 if width > 40 else 1.5
    start = margin
    stop = width - margin
    planted = rng.random() < 0.55
    yellow = rng.random() < 0.12
    line: Rgb = (214, 186, 96) if yellow else (218, 218, 212)
    count = int((depth - 2) // module)
    offset = 1 + (depth - 2 - count * module) / 2
    if count == 0:
        if depth - 2 >= row + 4:
            bays(site, start, x1=stop, head=1.2, side=1, slant=slant, filled=filled, line=line)
        return
    for index in range(count):
        y = offset + index * module
        bays(site, start, x1=stop, head=y, side=1, slant=slant, filled=filled, line=line)
        bays(site, start, x1=stop, head=y + module, side=-1, slant=slant, filled=filled, line=line)
        if rng.random() < 0.5:  # arrows and cars on the aisle
            for x in np.arange(start + 8, stop - 8, 30):
                arrow = _arrow(x, row + y + aisle / 2)
                site.polygon(arrow, line, Material.PAINT)
        if rng.random() < 0.45 and stop - start > 24:
            model = fleet.small()
            x = rng.uniform(start + 8, stop - 8)
            site.vehicle(model, x, y=y + row + aisle / 2 + 0.7, angle=0.0)
        for stain_y in (y + row + aisle * 0.3, y + row + aisle * 0.7):
            site.stain_rect((0, stain_y - 0.5, width, stain_y + 0.5), 123)
        if index > 0 and planted:
            for x in np.arange(
                start - 2.0,
                stop + 2.5,
                max((stop - start + 4) / max(round((stop - start) / 30), 1), 10),
            ):
                if x < start or x > stop:
                    site.rect(
                        (x - 1.3, y - 0.8 * row, x + 1.3, y + 0.8 * row),
                        site.palette.paving,
                        Material.PAVING,
                    )
                    site.rect(
                        (x - 1.1, y - 0.8 * row + 0.2, x + 1.1, y + 0.8 * row - 0.2),
                        site.palette.lawn,
                        Material.LAWN,
                    )
                    for step in (-0.45, 0.45):
                        if rng.random() < 0.8:
                            site.tree(x, y + step * row, rng.uniform(1.2, 2.4))
        if index > 0 and rng.random() < 0.6:
            for x in np.arange(start + 9, stop, 27):
                site.pole(x, y, 8.0)
    if planted:
        for x in np.arange(3, width - 3, rng.uniform(7, 12)):
            site.tree(x, 0.3, rng.uniform(1.3, 2.4))


def _arrow(x: float, y: float) -> list[tuple[float, float]]:
    """List the corners of an arrow of 3 m along an aisle, which begins at a place."""
    shaft = 0.15
    head = 0.4
    neck = x + 2
    return [
        (x, y - shaft),
        (neck, y - shaft),
        (neck, y - head),
        (x + 3, y),
        (neck, y + head),
        (neck, y + shaft),
        (x, y + shaft),
    ]


def bays(
    site: Site, x0: float, x1: float, head: float, side: int, slant: float, filled: float, line: Rgb
) -> None:
    """Build a row of bays whose heads lie on y = head and which open towards ``side``."""
    rng = site.rng
    fleet = site.fleet
    length = fleet.bay_length_m
    width = fleet.bay_width_m
    pitch = width / math.cos(slant)
    direction = np.array([math.sin(slant), side * math.cos(slant)])  # from the head to the aisle
    heading = math.atan2(-direction[1], -direction[0])
    reach = length * math.sin(slant)
    count = int((x1 - x0 - reach) // pitch)
    reverse = rng.uniform(0.05, 0.4)
    clusters = rng.random()
    for index in range(count + 1):
        x = x0 + index * pitch
        site.line(x, head, x + direction[0] * length, head + direction[1] * length, 0.11, line)
        if index == count:
            break
        middle = np.array([x + pitch / 2, head])
        if rng.random() < 0.5:  # oil stains
            spot = middle + direction * rng.uniform(1.0, 3.8)
            angles = np.linspace(0, 2 * np.pi, 9, endpoint=False)
            radius = rng.uniform(0.2, 0.6)
            site.stain(
                np.stack(
                    [spot[0] + radius * np.cos(angles), spot[1] + radius * np.sin(angles)], axis=1
                ),
                int(rng.integers(98, 120)),
            )
        density = filled * (0.75 + 0.5 * math.sin(index * 0.23 + 6 * clusters) ** 2)
        if rng.random() > density:
            continue
        model = fleet.small()
        clearance = 0.25 + model.width_m / 2 * math.tan(slant) + rng.exponential(0.18)
        protrusion = min(
            clearance, max(length - model.length_m, 0.25 + model.width_m / 2 * math.tan(slant))
        )
        turn = float(np.clip(rng.normal(0, 0.018), -0.05, 0.05))
        slack = max(
            (width - model.width_m) / 2 - 0.12 - abs(math.sin(turn)) * model.length_m / 2, 0.0
        )
        across = float(np.clip(rng.normal(0, 0.10), -slack, slack))
        centre = (
            middle
            + direction * (protrusion + model.length_m / 2)
            + np.array([direction[1], -direction[0]]) * across
        )
        site.vehicle(
            model,
            float(centre[0]),
            y=float(centre[1]),
            angle=heading + turn + (math.pi if rng.random() < reverse else 0.0),
        )


def halls(site: Site, width: float, depth: float) -> None:
    """Build a large hall or supermarket with its yard or car park."""
    rng = site.rng
    along = depth * rng.uniform(0.38, 0.5)
    hall = flat_roof_rgb(site.rng)
    site.rect((0, 0, width, depth), site.palette.asphalt, Material.ASPHALT)
    inset = rng.uniform(4, 8)
    building = (inset, 3.0, width - rng.uniform(4, 14), 3.0 + along)
    parts: tuple[Rect, ...] = (building,)
    if rng.random() < 0.5:
        middle = rng.uniform(0.35, 0.65) * width
        parts = (
            building,
            (
                middle,
                3.0,
                min(middle + rng.uniform(12, 30), building[2]),
                3.0 + along + rng.uniform(3, 7),
            ),
        )
    site.roof(parts, "flat", rng.uniform(6, 10), hall)
    yard = building[3] + 8.5
    if rng.random() < 0.6 and yard < depth:
        car_park(site.at(0, yard), width, depth - yard)
        return
    site.rect((0, yard - 8, width, depth), jitter(rng, site.palette.paving, 6), Material.PAVING)
    x = 6.0
    while x < width - 8:
        kind = rng.random()
        if kind < 0.35:
            model = site.fleet.large("truck", "semitrailer")
            if yard + 1 + model.length_m < depth - 2:
                site.vehicle(model, x, y=yard + 1 + model.length_m / 2, angle=math.pi / 2)
            x += 4.2
        elif kind < 0.7:
            rgb = jitter(
                rng,
                [(150, 62, 44), (60, 86, 128), (176, 174, 166), (74, 110, 84), (190, 140, 60)][
                    int(rng.integers(5))
                ],
                12,
            )
            for row in range(rng.integers(1, 3)):
                y = yard + 1 + row * 6.4
                if y + 6.06 < depth - 2:
                    site.box((x - 1.22, y, x + 1.22, y + 6.06), 2.6, jitter(rng, rgb, 10))
            x += rng.choice([2.7, 3.6])
        else:
            x += rng.uniform(2, 9)
