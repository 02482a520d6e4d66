"""Countryside blocks: fields, vineyards, orchards, meadows, woods, farms."""

from __future__ import annotations

import math

import numpy as np

from research.scenes.homes import garden, house
from research.scenes.site import Site, jitter, pick
from research.scenes.world import Material, Rect, Rgb, corners_of


def field(site: Site, width: float, depth: float) -> None:
    """Build arable land with furrows or tramlines."""
    rng = site.rng
    palette = site.palette
    kinds: tuple[tuple[Rgb, Material], ...] = (
        (palette.soil, Material.SOIL),
        ((182, 164, 122), Material.CROP),
        ((112, 126, 84), Material.CROP),
        ((136, 138, 96), Material.CROP),
    )
    rgb, material = pick(rng, kinds)
    edge = rng.uniform(1.0, 3.0)
    site.rect((0, 0, width, depth), palette.meadow, Material.MEADOW)
    plot = (edge, edge, width - edge, depth - edge)
    _field_plot(site, plot, jitter(rng, rgb, 10, 0.07), material)
    own, long, broad = _along_rows(site, width, depth, turned=width < depth)
    # Furrows.
    spacing = float(rng.choice([0.75, 1.5, 3.0]))
    for y in np.arange(edge + spacing, broad - edge - 0.5, spacing):
        level = int(128 + rng.choice([-1, 1]) * rng.uniform(4, 12))
        furrow_end = y + spacing * rng.uniform(0.3, 0.6)
        own.stain_rect((edge, y, long - edge, furrow_end), level)
    # Tramlines: two wheel tracks each.
    for y in np.arange(edge + 9, broad - 9, rng.uniform(18, 28)):
        for offset in (0.0, 1.9):
            track_y = y + offset
            own.stain_rect((edge, track_y, long - edge, track_y + 0.45), 112)
    for _ in range(rng.poisson(width * depth / 4000)):
        x = rng.uniform(edge + 8, width - edge - 8)
        y = rng.uniform(edge + 8, depth - edge - 8)
        to_border = min(x - edge, y - edge, width - edge - x, depth - edge - y)
        r = min(rng.uniform(3, 15), to_border)
        spot = jitter(rng, rgb, 14, 0.05)
        site.blob(x, y, r * 0.8, r * 0.6, rgb=spot, material=material)
    if rng.random() < 0.5:
        _tree_line(site, width)


def _field_plot(site: Site, plot: Rect, rgb: Rgb, material: Material) -> None:
    """Cover the plot of a field, and add it to the masked objects."""
    site.rect(plot, rgb, material)
    site.target("field", corners_of(plot))


def _along_rows(
    site: Site, width: float, depth: float, *, turned: bool
) -> tuple[Site, float, float]:
    """Return a site whose x axis runs along the rows, with its width and depth."""
    if turned:
        return site.at(width, 0, math.pi / 2), depth, width
    return site, width, depth


def vineyard(site: Site, width: float, depth: float) -> None:
    """Build rows of vines on soil."""
    rng = site.rng
    palette = site.palette
    site.rect((0, 0, width, depth), palette.meadow, Material.MEADOW)
    edge = rng.uniform(2, 4)
    plot = (edge, edge, width - edge, depth - edge)
    _field_plot(site, plot, jitter(rng, palette.soil, 8), Material.SOIL)
    own, long, broad = _along_rows(site, width, depth, turned=rng.random() >= 0.5)
    spacing = rng.uniform(1.9, 2.8)
    green = pick(rng, palette.leaves)
    for y in np.arange(edge + 1.2, broad - edge - 1.0, spacing):
        start = edge + 0.5
        # Dead plants leave gaps.
        while start < long - edge - 2:
            stop = min(start + rng.exponential(40) + 3, long - edge - 0.5)
            count = max(int((stop - start) / 1.2), 3)
            xs = np.linspace(start, stop, count)
            half = 0.38
            upper_y = y + half + rng.normal(0, 0.10, count)
            lower_y = y - half + rng.normal(0, 0.10, count)
            upper = np.stack([xs, upper_y], axis=1)
            lower = np.stack([xs, lower_y], axis=1)
            row = np.vstack([upper, lower[::-1]])
            own.polygon(row, jitter(rng, green, 4, 0.05), Material.CROP)
            own.stain_rect((start, y + 0.1, stop, y + 0.75), 94)
            start = stop + rng.uniform(0.8, 2.5)


def orchard(site: Site, width: float, depth: float) -> None:
    """Build an orchard: trees on a lattice."""
    rng = site.rng
    palette = site.palette
    site.rect((0, 0, width, depth), palette.meadow, Material.MEADOW)
    if rng.random() < 0.5:
        rgb = palette.soil
        material = Material.SOIL
    else:
        rgb = palette.lawn
        material = Material.MEADOW
    plot = (1.5, 1.5, width - 1.5, depth - 1.5)
    _field_plot(site, plot, jitter(rng, rgb, 8), material)
    spacing = rng.uniform(4.5, 7)
    size = rng.uniform(1.2, 2.2)
    for x in np.arange(4, width - 3, spacing):
        for y in np.arange(4, depth - 3, spacing):
            if rng.random() < 0.94:
                tree_x = x + rng.normal(0, 0.3)
                tree_y = y + rng.normal(0, 0.3)
                site.tree(tree_x, tree_y, float(size * rng.uniform(0.8, 1.2)))


def meadow(site: Site, width: float, depth: float) -> None:
    """Build rough grass with bushes and trodden ground."""
    rng = site.rng
    palette = site.palette
    site.rect((0, 0, width, depth), jitter(rng, palette.meadow, 8), Material.MEADOW)
    for _ in range(rng.poisson(width * depth / 500)):
        blot = pick(rng, (palette.soil, palette.lawn, palette.meadow))
        x = rng.uniform(3, width - 3)
        y = rng.uniform(3, depth - 3)
        to_border = min(x, y, width - x, depth - y)
        size = min(rng.uniform(1.5, 9), to_border) * 0.8
        size_y = size * rng.uniform(0.5, 1)
        rgb = jitter(rng, blot, 8, 0.06)
        site.blob(x, y, size, size_y, rgb=rgb, material=Material.MEADOW, rough=0.3)
    _track(site, width, depth)
    site.grove((1, 1, width - 1, depth - 1), 0.0025 * palette.greenery)
    for _ in range(rng.poisson(width * depth / 220)):
        site.bush(rng.uniform(1, width - 1), rng.uniform(1, depth - 1))


def wood(site: Site, width: float, depth: float) -> None:
    """Build a wood: dense trees."""
    rng = site.rng
    palette = site.palette
    site.rect((0, 0, width, depth), jitter(rng, palette.meadow, 6), Material.MEADOW)
    site.grove((2.5, 2.5, width - 2.5, depth - 2.5), rng.uniform(0.02, 0.05))


def _track(site: Site, width: float, depth: float) -> None:
    """Add a dirt track of two ruts across the block."""
    rng = site.rng
    a, b = rng.uniform(0.15, 0.85, 2)
    xs = np.linspace(0, 1, 16)
    ys = a + (b - a) * xs + 0.05 * np.sin(xs * 7 + rng.uniform(0, 6))
    for offset in (-0.85, 0.85):
        centre = np.clip(ys * depth + offset, 1, depth - 1)
        upper = np.stack([xs * width, centre + 0.4], axis=1)
        lower = np.stack([xs * width, centre - 0.4], axis=1)
        rut = np.vstack([upper, lower[::-1]])
        site.polygon(rut, jitter(rng, site.palette.gravel, 5), Material.SOIL)


def _tree_line(site: Site, width: float) -> None:
    x = 1.0
    while x < width - 1:
        site.tree(x, 0.8 + site.rng.normal(0, 0.3))
        x += site.rng.uniform(2.5, 9)


def farm(site: Site, width: float, depth: float) -> None:
    """Build a farmyard with house, barns, machines, cars and perhaps a pool."""
    rng = site.rng
    palette = site.palette
    meadow(site, width, depth)
    if min(width, depth) < 55:
        garden(site.at(width * 0.2, 0), min(width * 0.6, 30), min(depth, 45))
        return
    yard_w = 34.0
    yard_d = 26.0
    x0 = rng.uniform(8, width - yard_w - 10)
    own = site.at(x0, 4)
    own.rect((yard_w / 2 - 2, -4.5, yard_w / 2 + 2, 2), palette.gravel, Material.GRAVEL)
    own.blob(
        yard_w / 2,
        yard_d / 2,
        yard_w / 2 + 3,
        yard_d / 2 + 2,
        rgb=palette.gravel,
        material=Material.GRAVEL,
        rough=0.05,
    )
    roof: Rgb = (168, 168, 164)
    if rng.random() < 0.6:
        roof = pick(rng, palette.roofs)
    barn = jitter(rng, roof, 8)
    barn_end = rng.uniform(20, 30)
    own.roof(((0, yard_d - 2, barn_end, yard_d + 10),), "gable", 5.0, barn)
    house(own.at(-6, 3), rng.uniform(9, 11), rng.uniform(10, 14))
    x = 9.0
    while x < yard_w - 3:
        if rng.random() < 0.55:
            kind = rng.random()
            model = site.fleet.small() if kind < 0.75 else site.fleet.large("caravan", "truck")
            y = 10 + rng.uniform(0, 2.0)
            turn = float(np.clip(rng.normal(0, 0.1), -0.2, 0.2))
            own.vehicle(model, x, y=y, angle=math.pi / 2 + turn)
        elif rng.random() < 0.3:
            machine = jitter(rng, (120, 84, 62), 14)
            own.box((x - 1.2, 8, x + 1.2, 14), 2.6, machine)
        x += 4.6
    if rng.random() < 0.6:
        pool_x = -1 + yard_w / 2 + rng.uniform(-6, 6)
        own.pool(pool_x, yard_d + 20, rng.normal(0, 0.2))
    for _ in range(rng.poisson(9 * palette.greenery)):
        angle = rng.uniform(0, 2 * np.pi)
        tree_x = yard_w / 2 + 27 * math.cos(angle)
        tree_y = yard_d / 2 + 24 * math.sin(angle)
        own.tree(tree_x, max(tree_y, -2.5))
