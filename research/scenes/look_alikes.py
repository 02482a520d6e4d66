"""Scenes without cars, of equal things that a detector may take for cars.

A scene shows 3 to 100 things of one model in rows, in blocks or scattered, on a ground that suits
them, at an exact scale.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from research.scenes.fleet import Fleet
from research.scenes.further_things import FURTHER_THINGS
from research.scenes.render import photograph_world
from research.scenes.site import Palette, Site, jitter, pick
from research.scenes.small_vehicles import BRIGHT_PAINTS, SMALL_VEHICLES
from research.scenes.sprites import Sun
from research.scenes.things import GREEN, HARD, THINGS, draw_model, place
from research.scenes.truth import FleetKind, Scene
from research.scenes.world import Frame, Material, Rgb, World

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from numpy.random import Generator

    from research.scenes.things import Model

LOOK_ALIKES = THINGS | FURTHER_THINGS
"""Kinds of things of the set of look-alikes."""

ALL_THINGS = LOOK_ALIKES | SMALL_VEHICLES
"""All kinds of things."""

FIRST_RECORDED_SEED = 0
"""Seeds from here on are those of the recorded set; those from 10,000 on are for fitting."""

_SIZES_PX = ((640, 480), (800, 600), (960, 720))
_MIN_THINGS = 3
_MAX_THINGS = 100
_ARRANGEMENTS = ("row", "block", "scatter")
_ARRANGEMENT_SHARES = (0.3, 0.4, 0.3)
# Share of the image, at most, on which things stand.
_SPREAD = 0.9
# Cars in the places of things: the usual length and width of one, its range in pixels, and the
# shares of fleets of one model and of bright paints.
_CAR_M = (4.4, 1.8)
_CAR_PX = (14.0, 70.0)
_ONE_MODEL_SHARE = 0.4
_BRIGHT_SHARE = 0.3
_GROUNDS_OF_CARS = (*HARD, *GREEN, Material.PLAIN)


class Spacing(NamedTuple):
    """How much room things take.

    Attributes:
        length_m: length of one.
        width_m: width of one.
        gap: usual gap to the next one, in widths.
    """

    length_m: float
    width_m: float
    gap: float


class LookAlikes(NamedTuple):
    """Scene of look-alikes.

    Attributes:
        name: kind and seed, as in a file name.
        kind: key of ``ALL_THINGS``.
        scene: image and truth.
        n_things: number of things in view.
        length_m: length of one.
    """

    name: str
    kind: str
    scene: Scene
    n_things: int
    length_m: float


def look_alikes(
    kinds: Iterable[str] = LOOK_ALIKES, first_seed: int = FIRST_RECORDED_SEED, per_kind: int = 2
) -> Iterator[LookAlikes]:
    """Render several scenes of each kind of thing.

    Args:
        kinds: keys of ``ALL_THINGS``.
        first_seed: seed of the first scene; each further one has the next.
        per_kind: number of scenes of each kind.
    """
    for offset, kind in enumerate(list(kinds) * per_kind):
        yield render_look_alikes(kind, first_seed + offset)


def render_look_alikes(kind: str, seed: int) -> LookAlikes:
    """Render a scene of look-alikes; the arguments determine every byte.

    Args:
        kind: key of ``ALL_THINGS``.
        seed: at least 0.
    """
    place_rng, paint_rng, camera_rng = np.random.default_rng(seed).spawn(3)
    thing = ALL_THINGS[kind]
    model = draw_model(thing, place_rng)
    length_px = float(np.exp(place_rng.uniform(*np.log(thing.pixels))))
    gsd_m_per_px = model.length_m / length_px
    width_px, height_px = pick(place_rng, _SIZES_PX)
    size_m = (width_px * gsd_m_per_px, height_px * gsd_m_per_px)
    sun = Sun.draw(place_rng)
    world = World()
    centre = Frame(size_m[0] / 2, size_m[1] / 2, 0.0)
    fleet = Fleet(4.6, place_rng, "passenger")
    site = Site(world, centre, rng=place_rng, fleet=fleet, palette=Palette.draw(place_rng))
    _build_ground(site, pick(place_rng, thing.grounds), size_m)
    centres = _build_things(site, model, size_m)
    scene = photograph_world(
        world,
        sun,
        gsd_m_per_px=gsd_m_per_px,
        width_px=width_px,
        height_px=height_px,
        paint_rng=paint_rng,
        camera_rng=camera_rng,
        seed=seed,
        parameters={"things": kind, "length_m": model.length_m},
    )
    inside = (np.abs(centres) < np.array(size_m) / 2).all(axis=1)
    name = f"{kind.replace(' ', '_')}_{seed}"
    n_things = int(inside.sum())
    return LookAlikes(name, kind, scene=scene, n_things=n_things, length_m=model.length_m)


def render_cars(seed: int) -> Scene:
    """Render cars in the places of look-alikes; the seed determines every byte.

    They teach a network that neither the ground nor the rows of these scenes show things. Some
    fleets have one model, and some have bright paints.

    Args:
        seed: at least 0.
    """
    place_rng, paint_rng, camera_rng = np.random.default_rng(seed).spawn(3)
    length_px = float(np.exp(place_rng.uniform(*np.log(_CAR_PX))))
    gsd_m_per_px = _CAR_M[0] / length_px
    width_px, height_px = pick(place_rng, _SIZES_PX)
    size_m = (width_px * gsd_m_per_px, height_px * gsd_m_per_px)
    sun = Sun(place_rng.uniform(0, 2 * math.pi), math.radians(place_rng.uniform(25, 64)))
    world = World()
    centre = Frame(size_m[0] / 2, size_m[1] / 2, 0.0)
    kind: FleetKind = "mixed" if place_rng.random() < 0.5 else "passenger"
    fleet = Fleet(place_rng.uniform(4.0, 4.9), place_rng, kind)
    site = Site(world, centre, rng=place_rng, fleet=fleet, palette=Palette.draw(place_rng))
    _build_ground(site, pick(place_rng, _GROUNDS_OF_CARS), size_m)
    _park_cars(site, size_m)
    return photograph_world(
        world,
        sun,
        gsd_m_per_px=gsd_m_per_px,
        width_px=width_px,
        height_px=height_px,
        paint_rng=paint_rng,
        camera_rng=camera_rng,
        seed=seed,
        parameters={"things": "cars"},
    )


def _build_ground(site: Site, material: Material, size_m: tuple[float, float]) -> None:
    """Cover the view with one ground, patches of others, a path, and trees at its border."""
    rng = site.rng
    palette = site.palette
    tones: dict[Material, Rgb] = {
        Material.LAWN: palette.lawn,
        Material.MEADOW: palette.meadow,
        Material.CROP: (182, 164, 122),
        Material.SOIL: palette.soil,
        Material.GRAVEL: palette.gravel,
        Material.ASPHALT: palette.asphalt,
        Material.PAVING: palette.paving,
        Material.PLAIN: (176, 172, 164),
        Material.WATER: (70, 92, 96),
    }
    width, height = size_m
    half = math.hypot(width, height)
    rgb = jitter(rng, tones[material], 8, 0.06)
    site.rect((-half, -half, half, half), rgb, material)
    for _ in range(rng.poisson(4)):
        x, y = _within(rng, size_m)
        radius = rng.uniform(0.03, 0.12) * width
        patch = jitter(rng, rgb, 14, 0.07)
        site.blob(x, y, radius, 0.7 * radius, rgb=patch, material=material, rough=0.25)
    if material != Material.WATER and rng.random() < 0.5:
        broad = rng.uniform(0.02, 0.06) * width
        path = site.at(0, rng.uniform(-0.5, 0.5) * height, rng.normal(0, 0.3))
        path.rect((-half, -broad, half, broad), jitter(rng, palette.paving), Material.PAVING)
    if material in (Material.LAWN, Material.MEADOW):
        for _ in range(rng.poisson(3)):
            x, y = _within(rng, size_m)
            site.tree(x, y, rng.uniform(0.02, 0.05) * width)


def _build_things(site: Site, model: Model, size_m: tuple[float, float]) -> np.ndarray:
    """Place things of a model; return their centres ``[n, 2]`` from the middle of the view."""
    spacing = Spacing(model.length_m, model.width_m, model.thing.gap)
    poses = _arranged(site.rng, spacing, size_m)
    for x, y, angle in poses.tolist():
        place(site, model, x, y, angle=angle)
    return poses[:, :2]


def _park_cars(site: Site, size_m: tuple[float, float]) -> None:
    """Park the cars of a fleet as things stand."""
    rng = site.rng
    spacing = Spacing(*_CAR_M, rng.uniform(0.3, 0.7))
    model = site.fleet.small()
    is_one_model = rng.random() < _ONE_MODEL_SHARE
    is_bright = rng.random() < _BRIGHT_SHARE
    for x, y, angle in _arranged(rng, spacing, size_m).tolist():
        car = model if is_one_model else site.fleet.small()
        if is_bright and not is_one_model:
            car = replace(car, paint=pick(rng, BRIGHT_PAINTS))
        heading = angle + math.pi * int(rng.integers(2))
        site.vehicle(car, x, y, angle=heading)


def _arranged(rng: Generator, spacing: Spacing, size_m: tuple[float, float]) -> np.ndarray:
    """Arrange things in rows, in blocks or scattered; return x, y and angle ``[n, 3]``."""
    arrangement = rng.choice(_ARRANGEMENTS, p=_ARRANGEMENT_SHARES)
    wanted = int(np.exp(rng.uniform(math.log(_MIN_THINGS), math.log(_MAX_THINGS))))
    turn = rng.uniform(0, math.pi)
    gap_m = spacing.width_m * spacing.gap * rng.uniform(0.6, 1.6)
    if arrangement == "scatter":
        return _scattered(rng, spacing, wanted, size_m)
    n_rows = 1 if arrangement == "row" else max(2, round(math.sqrt(wanted / 2)))
    poses = _in_rows(rng, spacing, wanted, n_rows=n_rows, gap_m=gap_m)
    turned = Frame(0.0, 0.0, turn)
    return np.column_stack([turned.points(poses[:, :2]), poses[:, 2] + turn])


def _in_rows(
    rng: Generator, spacing: Spacing, wanted: int, *, n_rows: int, gap_m: float
) -> np.ndarray:
    """Arrange things side by side in rows; return x, y and angle ``[n, 3]``."""
    pitch = spacing.width_m + gap_m
    row_pitch = spacing.length_m * rng.uniform(1.1, 1.9)
    n_columns = math.ceil(wanted / n_rows)
    sloppy = rng.uniform(0, 0.08)
    poses = []
    for row in range(n_rows):
        for column in range(n_columns):
            if rng.random() < 0.05:
                continue
            x = (row - (n_rows - 1) / 2) * row_pitch + sloppy * spacing.width_m * rng.normal()
            y = (column - (n_columns - 1) / 2) * pitch + sloppy * spacing.width_m * rng.normal()
            poses.append((x, y, sloppy * rng.normal()))
    return np.array(poses[:_MAX_THINGS]).reshape(-1, 3)


def _scattered(
    rng: Generator, spacing: Spacing, wanted: int, size_m: tuple[float, float]
) -> np.ndarray:
    """Scatter things that do not touch; return x, y and angle ``[n, 3]``."""
    poses: list[tuple[float, float, float]] = []
    for _ in range(20 * wanted):
        if len(poses) == wanted:
            break
        x, y = _within(rng, size_m)
        is_free = all(math.hypot(x - a, y - b) > 1.2 * spacing.length_m for a, b, _ in poses)
        if is_free:
            poses.append((x, y, rng.uniform(0, math.pi)))
    return np.array(poses).reshape(-1, 3)


def _within(rng: Generator, size_m: tuple[float, float]) -> tuple[float, float]:
    """Draw a place in the view, from its middle."""
    x, y = (rng.uniform(-0.5, 0.5, 2) * _SPREAD * np.array(size_m)).tolist()
    return x, y
