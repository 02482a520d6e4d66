"""Scenes in which the straight edge of a roof or of a shadow cuts cars.

Cars stand in a row, at right angles to an edge below which a part of each is hidden: the edge of a
canopy or of a bridge, or that of a building's shadow. Further cars stand in the open.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from research.scenes.fleet import Fleet
from research.scenes.render import photograph_world
from research.scenes.site import Palette, Site, flat_roof_rgb, jitter, pick
from research.scenes.sprites import Sun
from research.scenes.truth import Scene
from research.scenes.world import Frame, Material, World

if TYPE_CHECKING:
    from collections.abc import Iterator

COVERS = ("canopy", "bridge", "shadow")
"""Kinds of edges that cut cars."""

FIRST_RECORDED_SEED = 0
"""Seeds from here on are those of the recorded set, those from 10,000 on for fitting."""

_SIZES_PX = ((640, 480), (800, 600), (960, 720))
_MAX_GSD = 0.15
_MIN_GSD = 0.035
_HIDDEN_SHARES = (0.15, 0.55)
_MAX_CUT = 6
_MAX_WHOLE = 4
# Distance along the edge between the middles of neighbouring cars.
_PITCH_M = (2.6, 3.4)


class Covered(NamedTuple):
    """Scene of covered cars.

    Attributes:
        name: cover and seed, as in a file name.
        cover: one of ``COVERS``.
        scene: image and truth.
        n_cut: number of cars that the edge cuts.
        n_whole: number of cars in the open.
        hidden_share: mean share of the length that is hidden.
    """

    name: str
    cover: str
    scene: Scene
    n_cut: int
    n_whole: int
    hidden_share: float


def covered(first_seed: int = FIRST_RECORDED_SEED, per_cover: int = 20) -> Iterator[Covered]:
    """Render several scenes of each cover.

    Args:
        first_seed: seed of the first scene; each further one has the next.
        per_cover: number of scenes of each cover.
    """
    for offset, cover in enumerate(COVERS * per_cover):
        yield render_covered(cover, first_seed + offset)


def render_covered(cover: str, seed: int) -> Covered:
    """Render a scene of covered cars; the arguments determine every byte.

    Args:
        cover: one of ``COVERS``.
        seed: at least 0.
    """
    place_rng, paint_rng, camera_rng = np.random.default_rng(seed).spawn(3)
    gsd_m_per_px = float(np.exp(place_rng.uniform(math.log(_MIN_GSD), math.log(_MAX_GSD))))
    width_px, height_px = pick(place_rng, _SIZES_PX)
    size_m = (width_px * gsd_m_per_px, height_px * gsd_m_per_px)
    sun = Sun.draw(place_rng)
    n_cut = int(place_rng.integers(1, _MAX_CUT + 1))
    n_whole = 0
    if place_rng.random() < 0.5:
        n_whole = int(place_rng.integers(1, _MAX_WHOLE + 1))
    world = World()
    # The y axis leads from the covered side to the open one. A shadow falls along it.
    turn = place_rng.uniform(0, 2 * math.pi)
    if cover == "shadow":
        turn = sun.azimuth - math.pi / 2 + place_rng.uniform(-0.7, 0.7)
    frame = Frame(size_m[0] / 2, size_m[1] / 2, turn)
    fleet = Fleet(place_rng.uniform(4.2, 4.9), place_rng, "passenger")
    site = Site(world, frame, rng=place_rng, fleet=fleet, palette=Palette.draw(place_rng))
    _build_ground(site, size_m)
    # From the middle of the view to its corners: painting a roof takes longer with its square.
    reach = math.hypot(*size_m) / 2
    _build_cover(site, cover, sun, reach=reach)
    share = _park(site, n_cut)
    _park_whole(site, n_whole)
    scene = photograph_world(
        world,
        sun,
        gsd_m_per_px=gsd_m_per_px,
        width_px=width_px,
        height_px=height_px,
        paint_rng=paint_rng,
        camera_rng=camera_rng,
        seed=seed,
        parameters={"cover": cover, "n_cut": n_cut, "n_whole": n_whole},
    )
    return Covered(
        f"{cover}_{seed}",
        cover,
        scene=scene,
        n_cut=n_cut,
        n_whole=n_whole,
        hidden_share=share,
    )


def _build_ground(site: Site, size_m: tuple[float, float]) -> None:
    """Cover the view with a paved ground, and the far side with lawn and trees."""
    rng = site.rng
    palette = site.palette
    half = math.hypot(*size_m)
    ground = pick(rng, (palette.asphalt, palette.paving, palette.gravel))
    material = Material.ASPHALT if ground is palette.asphalt else Material.PAVING
    site.rect((-half, -half, half, half), jitter(rng, ground, 6), material)
    for _ in range(rng.poisson(3)):
        spot = (float(rng.uniform(-half, half) / 2), float(rng.uniform(0, half) / 2))
        radius = rng.uniform(0.5, 2.0)
        site.stain_rect((spot[0], spot[1], spot[0] + radius, spot[1] + radius / 2), 116)
    verge = rng.uniform(14.0, 20.0)
    site.rect((-half, verge, half, half), jitter(rng, palette.lawn, 8), Material.LAWN)
    site.grove((-half, verge + 4.0, half, half), 0.01)


def _build_cover(site: Site, cover: str, sun: Sun, *, reach: float) -> None:
    """Build what hides the side y < 0 of the site, a bridge as far as the view reaches."""
    rng = site.rng
    if cover == "shadow":
        # The end of the shadow lies at y = 0; cars stand at least 8 m from the wall.
        along = np.array([-math.sin(site.frame.angle), math.cos(site.frame.angle)])
        reach_per_m = float(np.dot(sun.shadow(1.0), along))
        height = rng.uniform(8.0, 14.0) / reach_per_m
        wall = -height * reach_per_m
        length = rng.uniform(20.0, 60.0)
        rect = (-length, wall - rng.uniform(10.0, 20.0), length, wall)
        # The shadow's ends are far from the cars.
        site.roof((rect,), "flat", height, flat_roof_rgb(rng))
        return
    depth = rng.uniform(5.0, 9.0) if cover == "canopy" else rng.uniform(9.0, 16.0)
    length = rng.uniform(14.0, 30.0) if cover == "canopy" else reach
    eaves = rng.uniform(2.4, 5.0) if cover == "canopy" else rng.uniform(4.5, 7.0)
    tone = flat_roof_rgb(rng)
    if cover == "bridge":
        tone = jitter(rng, site.palette.asphalt, 6)
    elif rng.random() < 0.4:
        tone = jitter(rng, pick(rng, site.palette.roofs), 6)
    site.roof(((-length, -depth, length, 0.0),), "flat", eaves, tone)


def _park(site: Site, n_cut: int) -> float:
    """Park cars across the edge y = 0; return the mean share of their length that is hidden."""
    rng = site.rng
    pitch = rng.uniform(*_PITCH_M)
    typical = rng.uniform(*_HIDDEN_SHARES)
    with_bays = rng.random() < 0.4
    shares = []
    for k in range(n_cut):
        x = (k - (n_cut - 1) / 2) * pitch
        model = site.fleet.small()
        share = float(np.clip(typical + rng.normal(0, 0.05), *_HIDDEN_SHARES))
        shares.append(share)
        y = (0.5 - share) * model.length_m
        heading = math.pi / 2 if rng.random() < 0.5 else -math.pi / 2
        site.vehicle(model, x + rng.normal(0, 0.08), y, angle=heading + rng.normal(0, 0.03))
        if with_bays:
            site.line(x - pitch / 2, -3.0, x - pitch / 2, 2.6)
    return float(np.mean(shares))


def _park_whole(site: Site, n_whole: int) -> None:
    """Park cars in the open, in a row opposite."""
    rng = site.rng
    if not n_whole:
        return
    first = rng.uniform(-6.0, 0.0)
    y = rng.uniform(8.5, 10.5)
    for k in range(n_whole):
        model = site.fleet.small()
        heading = math.pi / 2 if rng.random() < 0.5 else -math.pi / 2
        x = first + k * rng.uniform(2.7, 3.4)
        site.vehicle(model, x, y + rng.normal(0, 0.2), angle=heading + rng.normal(0, 0.05))
