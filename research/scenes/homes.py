"""Residential blocks: houses with gardens, flats, town houses."""

from __future__ import annotations

import math

import numpy as np

from research.scenes.car_parks import bays
from research.scenes.site import Site, flat_roof_rgb, jitter, pick
from research.scenes.world import Material, Rect, Rgb, corners_of

_SHED_RGB = (
    (128, 112, 96),
    (150, 150, 148),
    (104, 106, 110),
    (172, 120, 96),
    (198, 196, 190),
)
_PARASOL_RGB = ((222, 216, 200), (170, 60, 50), (90, 110, 90))


def houses(site: Site, width: float, depth: float) -> None:
    """Build one row of lots, or two back to back."""
    site.rect((0, 0, width, depth), site.palette.lawn, Material.LAWN)
    if depth < 34:
        _lots(site, width, depth)
        return
    _lots(site, width, depth / 2)
    _lots(site.at(width, depth, math.pi), width, depth / 2)


def _lots(site: Site, width: float, depth: float) -> None:
    size = site.rng.uniform(15, 24)
    count = max(int(width // size), 1)
    for index in range(count):
        garden(site.at(index * width / count, 0), width / count, depth)


def garden(site: Site, width: float, depth: float) -> None:
    """Build a house, its drive with cars, and its garden; the street is at y = 0."""
    rng = site.rng
    palette = site.palette
    _garden_ground(site, width, depth)
    drive = rng.uniform(3.0, 5.6) if width > 13 else 2.8
    setback = rng.uniform(4.5, 8)
    left = bool(rng.random() < 0.5)
    house_w = min(rng.uniform(8.5, 14), width - drive - 2.4)
    house_d = min(rng.uniform(7.5, 11.5), depth - setback - 3)
    if house_w < 5 or house_d < 5:
        site.grove((1, 1, width - 1, depth - 1), 0.02 * palette.greenery)
        return
    if left:
        x0 = drive + 1.2
        drive_x = 0.6
    else:
        x0 = 1.2
        drive_x = width - drive - 0.6
    drive_rgb = palette.paving if rng.random() < 0.6 else palette.gravel
    paved = jitter(rng, drive_rgb, 8, 0.06)
    drive_end = setback + rng.uniform(0.3, 0.9) * house_d
    site.rect((drive_x, -0.3, drive_x + drive, drive_end), paved, Material.PAVING)
    terrace_end = setback + house_d + rng.uniform(0.8, 4)
    terrace = (x0 - 0.7, setback - 0.7, x0 + house_w + 0.7, terrace_end)
    site.rect(terrace, jitter(rng, palette.paving, 10, 0.08), Material.PAVING)
    door_x = x0 + house_w / 2
    path = (door_x - 0.6, 0, door_x + 0.6, setback)
    site.rect(path, jitter(rng, palette.paving, 8), Material.PAVING)
    house(site.at(x0, setback), house_w, house_d)
    _drive_cars(site, drive_x, width=drive, end=drive_end)
    _garden_things(site, width, depth=depth, behind=setback + house_d)
    hedge = rng.random() < 0.5
    site.wall(0.2, 0.3 + rng.uniform(0, 1), x1=0.2, y1=depth, hedge=hedge)
    if rng.random() < 0.6:
        site.wall(0, depth - 0.3, x1=width, y1=depth - 0.3, hedge=rng.random() < 0.6)
    gap = (drive_x - 0.3, drive_x + drive + 0.3)
    front = rng.random() < 0.5
    site.wall(0.3, 0.4, x1=gap[0], y1=0.4, hedge=front)
    site.wall(gap[1], 0.4, x1=width - 0.3, y1=0.4, hedge=front)
    _garden_plants(site, width, depth=depth, back=setback + house_d, left=left)


def _garden_ground(site: Site, width: float, depth: float) -> None:
    """Cover a garden with lawn, meadow or bare soil, and patches of another."""
    rng = site.rng
    palette = site.palette
    ground = rng.random()
    if ground < 0.45:
        grass = palette.meadow if rng.random() < 0.5 else palette.lawn
        site.rect((0, 0, width, depth), jitter(rng, grass, 10, 0.08), Material.MEADOW)
    elif ground < 0.6:
        site.rect((0, 0, width, depth), jitter(rng, palette.soil, 8), Material.SOIL)
    else:
        site.rect((0, 0, width, depth), jitter(rng, palette.lawn, 8, 0.06), Material.LAWN)
    for _ in range(rng.poisson(1.5)):
        other = palette.soil if rng.random() < 0.5 else palette.meadow
        blot = jitter(rng, other, 8)
        x = rng.uniform(2, width - 2)
        y = rng.uniform(2, depth - 2)
        radius_x = min(rng.uniform(1, 4), x, width - x)
        radius_y = min(rng.uniform(1, 4), y, depth - y)
        site.blob(x, y, radius_x, radius_y, rgb=blot, material=Material.MEADOW)


def _garden_plants(site: Site, width: float, depth: float, back: float, *, left: bool) -> None:
    """Plant trees and bushes along the borders; ``back`` is the rear of the house."""
    rng = site.rng
    palette = site.palette
    for _ in range(rng.poisson(width * depth / 75 * palette.greenery)):
        if rng.random() < 0.75:
            site.tree(rng.uniform(1, width - 1), rng.uniform(back + 1.5, depth - 0.5))
        else:
            from_wall = rng.uniform(0.8, 2.0)
            x = width - from_wall if left else from_wall
            y = rng.uniform(0.5, depth)
            site.tree(x, y, rng.uniform(0.9, 2.2), conical=rng.random() < 0.2)
    for _ in range(rng.poisson(10 * palette.greenery)):
        side = rng.random()
        x = rng.uniform(0.6, width - 0.6) if side < 0.5 else float(rng.choice([0.9, width - 0.9]))
        y = rng.uniform(back + 1, depth - 0.5)
        site.bush(x, y)


def house(site: Site, width: float, depth: float) -> None:
    """Build a small house, straight or L-shaped."""
    rng = site.rng
    palette = site.palette
    middle = site.at(width / 2, depth / 2, rng.normal(0, 0.02))
    turned = middle.at(-width / 2, -depth / 2)
    rgb = jitter(rng, pick(rng, palette.roofs), 10, 0.07)
    if rng.random() > palette.pitched:
        style = "flat"
        rgb = flat_roof_rgb(site.rng)
    else:
        style = "hip" if rng.random() < 0.45 else "gable"
    parts: tuple[Rect, ...] = ((0, 0, width, depth),)
    if rng.random() < 0.45 and min(width, depth) > 7:
        share = rng.uniform(0.45, 0.65)
        if rng.random() < 0.5:
            back = (0, depth * (1 - share), width, depth)
            parts = (back, (0, 0, width * share, depth))
        else:
            right = (width * (1 - share), 0, width, depth)
            parts = ((0, 0, width, depth * share), right)
    turned.roof(parts, style, rng.uniform(3, 6.5), rgb)


def _drive_cars(site: Site, x: float, width: float, end: float) -> None:
    rng = site.rng
    fleet = site.fleet
    slots = 2 if width > 5 else 1
    for slot in range(slots):
        if rng.random() > 0.55:
            continue
        model = fleet.small()
        centre = x + width * (slot + 0.5) / slots
        position = 0.6 + model.length_m / 2 + rng.uniform(0, 0.8)
        turn = float(np.clip(rng.normal(0, 0.03), -0.06, 0.06))
        heading = float(rng.choice([-1, 1])) * math.pi / 2
        site.vehicle(model, centre, y=position, angle=turn + heading)
        # A second car behind the first one.
        if slots == 1 and rng.random() < 0.35 and end > 2 * fleet.max_length_m + 2.2:
            other = fleet.small()
            behind = 1.8 + fleet.max_length_m + other.length_m / 2
            site.vehicle(other, centre, y=behind, angle=math.pi / 2)


def _garden_things(site: Site, width: float, depth: float, behind: float) -> None:
    """Add a pool, shed, parasols, trampoline, table and beds, some as large as a car."""
    rng = site.rng
    palette = site.palette
    space = depth - behind
    if space > 8.5 and width > 13 and rng.random() < palette.pools:
        pool_x = width / 2 + rng.uniform(-1, 1) * max(width / 2 - 7.5, 0)
        site.pool(pool_x, behind + space / 2 + 0.8, rng.normal(0, 0.06))
        # Loungers.
        for _ in range(rng.integers(0, 4)):
            x = rng.uniform(2, width - 3)
            y = behind + rng.uniform(0.8, 1.6)
            site.box((x, y, x + 0.65, y + 1.9), 0.4, (226, 226, 220))
    elif space > 6 and rng.random() < 0.3:
        for row in range(rng.integers(2, 6)):
            y = behind + 2 + row * 0.9
            if y < depth - 1:
                bed_end = min(2 + width * 0.35, width - 1)
                bed = (2, y, bed_end, y + 0.55)
                site.rect(bed, jitter(rng, (92, 84, 58), 12), Material.CROP)
    if space > 5 and rng.random() < 0.55:
        sx = rng.uniform(1.8, 4.6)
        sy = rng.uniform(1.6, 2.6)
        x = float(rng.choice([1.0, width - sx - 1.0]))
        rgb = jitter(rng, pick(rng, _SHED_RGB), 14)
        shed = (x, depth - sy - 0.8, x + sx, depth - 0.8)
        site.box(shed, rng.uniform(2.0, 2.8), rgb)
    if rng.random() < 0.2 and space > 6:
        x = rng.uniform(3, width - 3)
        y = rng.uniform(behind + 3, depth - 2.5)
        radius = rng.uniform(1.4, 2.0)
        rim = (62, 92, 128) if rng.random() < 0.5 else (70, 96, 70)
        site.disc(x, y, radius=radius, height=0.7, rgb=rim)
        site.disc(x, y, radius=radius * 0.83, height=0.7, rgb=(44, 46, 48))
    if rng.random() < 0.4:
        x = rng.uniform(2, width - 2)
        y = behind + rng.uniform(0.8, 2.2)
        radius = rng.uniform(0.9, 1.5)
        parasol = jitter(rng, pick(rng, _PARASOL_RGB), 8)
        site.disc(x, y, radius=radius, height=2.2, rgb=parasol)
    if rng.random() < 0.12 and space > 6 and width > 11:
        x = rng.uniform(2, width - 6)
        y = behind + rng.uniform(1.5, max(space - 4.5, 1.6))
        # The beams of a pergola.
        for beam in np.arange(0, 3.6, 0.6):
            site.box((x, y + beam, x + 4, y + beam + 0.15), 2.3, (168, 142, 112))


def flats(site: Site, width: float, depth: float) -> None:
    """Build blocks of flats in lawns, with parking."""
    rng = site.rng
    palette = site.palette
    site.rect((0, 0, width, depth), palette.lawn, Material.LAWN)
    parking = site.fleet.bay_length_m + 6.5
    if depth < parking + 22:
        houses(site, width, depth)
        return
    apron: Rect = (0, 0, width, parking + 2)
    site.rect(apron, jitter(rng, palette.asphalt, 4, 0.08), Material.ASPHALT)
    site.target("parking-lot", corners_of(apron))
    filled = rng.uniform(0.4, 0.95)
    bays(
        site,
        2,
        x1=width - 2,
        head=parking + 1.2,
        side=-1,
        slant=0.0,
        filled=filled,
        line=(216, 216, 210),
    )
    y = parking + 7
    while y + 12 < depth - 2:
        deep = rng.uniform(11, 15)
        x = rng.uniform(3, 8)
        while x + 20 < width - 2:
            long = min(rng.uniform(22, 48), width - 3 - x)
            if y + deep < depth - 2:
                pitched = rng.random() < 0.5
                rgb = _roof_rgb(site, pitched=pitched)
                paved = (x - 1, y - 1, x + long + 1, y + deep + 1)
                site.rect(paved, palette.paving, Material.PAVING)
                parts: tuple[Rect, ...] = ((x, y, x + long, y + deep),)
                if rng.random() < 0.3 and y + deep + 12 < depth:
                    parts = (*parts, (x, y, x + 12, y + deep + 10))
                style = "flat"
                if pitched:
                    style = "hip" if rng.random() < 0.6 else "gable"
                site.roof(parts, style, rng.uniform(8, 16), rgb)
                door_x = x + long / 2
                path = (door_x - 0.9, parking + 2, door_x + 0.9, y)
                site.rect(path, palette.paving, Material.PAVING)
            x += long + rng.uniform(7, 14)
        y += deep + rng.uniform(12, 20)
    y = parking + 4
    lawn_area = width * (depth - y)
    for _ in range(rng.poisson(lawn_area / 130 * palette.greenery)):
        site.tree(rng.uniform(1, width - 1), rng.uniform(y, depth - 1))
    for _ in range(rng.poisson(lawn_area / 120)):
        site.bush(rng.uniform(1, width - 1), rng.uniform(y, depth - 1))


def _roof_rgb(site: Site, *, pitched: bool) -> Rgb:
    """Draw the colour of a roof."""
    if not pitched:
        return flat_roof_rgb(site.rng)
    return jitter(site.rng, pick(site.rng, site.palette.roofs), 8)


def town(site: Site, width: float, depth: float) -> None:
    """Build a closed perimeter of town houses around courtyards."""
    rng = site.rng
    palette = site.palette
    site.rect((0, 0, width, depth), jitter(rng, palette.paving, 6, 0.08), Material.PAVING)
    deep = min(rng.uniform(10, 13), depth / 2 - 3)
    if deep < 7:
        houses(site, width, depth)
        return
    for row in range(2):
        own = site if row == 0 else site.at(width, depth, math.pi)
        x = 0.5
        while x + 7 < width:
            long = min(rng.uniform(9, 20), width - 0.5 - x)
            pitched = rng.random() < min(palette.pitched, 0.8)
            rgb = _roof_rgb(site, pitched=pitched)
            part = (x, 0.5, x + long, 0.5 + deep + rng.normal(0, 0.8))
            style = "gable" if pitched else "flat"
            own.roof((part,), style, rng.uniform(8, 15), rgb)
            x += long
    yard = (1.0, deep + 3.0, width - 1.0, depth - deep - 3.0)
    left, top, right, bottom = yard
    lowest = max(bottom - 4, top + 0.1)
    for _ in range(rng.poisson(max(width * (depth - 2 * deep) / 260, 0))):
        x = rng.uniform(left, right - 5)
        y = rng.uniform(top, lowest)
        if y + 3 < bottom:
            radius_x = rng.uniform(2, 6)
            radius_y = rng.uniform(1.5, 3)
            site.blob(x, y, radius_x, radius_y, rgb=palette.lawn, material=Material.LAWN)
            site.tree(x, y)
    for _ in range(rng.poisson(2)):
        x = rng.uniform(left, right - 6)
        y = rng.uniform(top, lowest)
        if y + 3.5 < bottom:
            shed = (x, y, x + rng.uniform(3, 6), y + rng.uniform(2.5, 3.4))
            site.box(shed, 2.6, jitter(rng, (140, 136, 130), 12))
