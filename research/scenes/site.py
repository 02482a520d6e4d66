"""Site: a local frame of the world, with methods that place surfaces, objects and vehicles."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, TypeVar, cast

import numpy as np
from numpy.random import Generator
from numpy.typing import ArrayLike, NDArray

from research.scenes.fleet import Fleet, VehicleModel
from research.scenes.raster import polygon_area
from research.scenes.truth import Category
from research.scenes.world import (
    Box,
    Frame,
    Material,
    PlacedVehicle,
    Rect,
    Rgb,
    Roof,
    Stain,
    Surface,
    Target,
    Tree,
    World,
    corners_of,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

WHITE: Rgb = (222, 222, 216)
Option = TypeVar("Option")


def pick(rng: Generator, options: Sequence[Option]) -> Option:
    """Draw one of several options, all equally likely."""
    return options[int(rng.integers(len(options)))]


def jitter(rng: Generator, rgb: Rgb, spread: float = 6.0, gain: float = 0.05) -> Rgb:
    """Vary a colour at random."""
    brightness, red, green, blue = rng.standard_normal(4).tolist()
    scale = 1 + brightness * gain
    shift = brightness * spread / 3
    hue = spread / 6
    varied = []
    for channel, tint in zip(rgb, (red, green, blue), strict=True):
        value = channel * scale + shift + hue * tint
        varied.append(int(min(max(value, 5), 245)))
    return cast("Rgb", tuple(varied))


def flat_roof_rgb(rng: Generator) -> Rgb:
    """Draw the colour of a flat roof: gravel, membrane or bitumen."""
    tones: tuple[Rgb, ...] = (
        (204, 200, 192),
        (176, 172, 164),
        (150, 148, 144),
        (120, 120, 120),
        (222, 222, 220),
        (168, 156, 142),
    )
    return jitter(rng, pick(rng, tones), 6, 0.05)


@dataclass(frozen=True)
class Palette:
    """Colours and vegetation of a region."""

    asphalt: Rgb
    paving: Rgb
    lawn: Rgb
    meadow: Rgb
    soil: Rgb
    gravel: Rgb
    leaves: tuple[Rgb, ...]
    roofs: tuple[Rgb, ...]
    pitched: float
    """Share of small houses with a pitched roof."""
    greenery: float
    """Density of trees, about 0.5 to 1.5."""
    pools: float
    """Share of gardens with a pool."""

    @classmethod
    def draw(cls, rng: Generator) -> Palette:
        """Draw one of several kinds of region, with variation."""
        greens: tuple[Rgb, ...] = (
            (96, 110, 78),
            (84, 102, 72),
            (108, 116, 80),
            (76, 92, 70),
            (104, 110, 88),
        )
        # Cooler and darker greens, towards conifers.
        if rng.random() < 0.35:
            greens = ((76, 92, 72), (68, 84, 66), (88, 102, 76), (96, 106, 82))
        red: tuple[Rgb, ...] = (
            (172, 116, 90),
            (158, 104, 82),
            (182, 134, 106),
            (150, 112, 92),
            (176, 140, 116),
        )
        brown: tuple[Rgb, ...] = ((124, 108, 98), (142, 124, 110), (110, 100, 94), (164, 150, 136))
        slate: tuple[Rgb, ...] = ((112, 114, 120), (96, 98, 104), (134, 132, 130), (128, 112, 104))
        pale: tuple[Rgb, ...] = ((205, 200, 190), (182, 174, 164), (214, 212, 206), (160, 140, 124))
        regions = (red, (*red, *brown), brown, slate, (*slate, *brown), pale)
        roofs = pick(rng, regions)
        tone = rng.uniform(92, 150)
        warm = rng.uniform(-3, 7)
        dry = rng.random() < 0.4
        lawn = (122, 124, 90) if dry else (100, 116, 80)
        meadow = (156, 146, 114) if dry else (120, 124, 90)
        return cls(
            asphalt=(int(tone + warm * 0.6), int(tone), int(tone - warm * 0.3)),
            paving=jitter(rng, (168, 164, 156), 8, 0.08),
            lawn=jitter(rng, lawn, 8),
            meadow=jitter(rng, meadow, 10),
            soil=_soil(rng),
            gravel=jitter(rng, (182, 172, 154), 8, 0.06),
            leaves=tuple(jitter(rng, rgb, 8, 0.08) for rgb in greens),
            roofs=tuple(jitter(rng, rgb, 6, 0.04) for rgb in roofs),
            pitched=0.3 if roofs is pale else 0.93,
            greenery=rng.uniform(0.6, 1.5),
            pools=float(rng.choice([0.08, 0.25, 0.55])),
        )


def _soil(rng: Generator) -> Rgb:
    """Draw the colour of soil, light or dark."""
    rgb: Rgb = (164, 142, 114) if rng.random() < 0.6 else (132, 112, 92)
    return jitter(rng, rgb, 8, 0.07)


@dataclass(frozen=True, eq=False)
class Site:
    """Local frame of a world, with its random generator, fleet and palette."""

    world: World
    frame: Frame
    rng: Generator
    fleet: Fleet
    palette: Palette
    kept_free: list[tuple[Frame, Rect]] = field(default_factory=list)
    """Rectangles without trees: buildings, pools, courts."""

    def at(self, x: float, y: float, angle: float = 0.0) -> Site:
        """Create the site of a frame inside this one."""
        return replace(self, frame=self.frame.at(x, y, angle))

    # Ground

    def polygon(self, points: ArrayLike, rgb: Rgb, material: Material) -> None:
        """Add a polygonal surface."""
        self.world.surfaces.append(Surface(self.frame.points(points), rgb, material))

    def rect(self, rect: Rect, rgb: Rgb, material: Material) -> None:
        """Add a rectangular surface x0, y0, x1, y1."""
        self.polygon(corners_of(rect), rgb, material)

    def blob(
        self,
        x: float,
        y: float,
        rx: float,
        ry: float,
        rgb: Rgb,
        material: Material,
        rough: float = 0.12,
    ) -> None:
        """Add an irregular round surface."""
        outline = _blob(self.rng, x, y=y, rx=rx, ry=ry, rough=rough)
        self.polygon(outline, rgb, material)

    def line(
        self, x0: float, y0: float, x1: float, y1: float, width: float = 0.12, rgb: Rgb = WHITE
    ) -> None:
        """Add a painted line."""
        length = math.hypot(x1 - x0, y1 - y0)
        nx = -(y1 - y0) / length * width / 2
        ny = (x1 - x0) / length * width / 2
        left_start = (x0 + nx, y0 + ny)
        left_end = (x1 + nx, y1 + ny)
        right_end = (x1 - nx, y1 - ny)
        right_start = (x0 - nx, y0 - ny)
        outline = [left_start, left_end, right_end, right_start]
        self.polygon(outline, rgb, Material.PAINT)

    def stain(self, points: ArrayLike, level: int) -> None:
        """Darken (level below 128) or lighten the ground."""
        self.world.stains.append(Stain(self.frame.points(points), level))

    def stain_rect(self, rect: Rect, level: int) -> None:
        """Add a rectangular stain."""
        self.stain(corners_of(rect), level)

    def crack(
        self, x: float, y: float, length: float, angle: float, level: int = 104, width: float = 0.12
    ) -> None:
        """Add a crack: an irregular dark line."""
        steps = max(int(length / 1.5), 2)
        turns = angle + np.cumsum(self.rng.normal(0, 0.25, steps))
        strides = np.stack([np.cos(turns), np.sin(turns)], axis=1) * length / steps
        path = np.array([x, y]) + np.cumsum(strides, axis=0)
        normal = np.stack([-np.sin(turns), np.cos(turns)], axis=1) * width / 2
        left = path + normal
        right = path - normal
        self.stain(np.vstack([left, right[::-1]]), level)

    def target(self, category: Category, *polygons: ArrayLike, area: float | None = None) -> None:
        """Add an object to be masked.

        Args:
            category: its category.
            polygons: its outline.
            area: area of the union; None for one polygon.
        """
        placed = tuple(self.frame.points(polygon) for polygon in polygons)
        if area is None:
            area = polygon_area(placed[0])
        self.world.targets.append(Target(category, placed, area))

    # Upright objects

    def box(self, rect: Rect, height: float, rgb: Rgb, *, leafy: bool = False) -> None:
        """Add a low upright block."""
        outline = self.frame.points(corners_of(rect))
        self.world.boxes.append(Box(outline, height, rgb, leafy))

    def disc(self, x: float, y: float, radius: float, height: float, rgb: Rgb) -> None:
        """Add a low cylinder."""
        angles = np.linspace(0, 2 * np.pi, 16, endpoint=False)
        circle_x = x + radius * np.cos(angles)
        circle_y = y + radius * np.sin(angles)
        outline = self.frame.points(np.stack([circle_x, circle_y], axis=1))
        self.world.boxes.append(Box(outline, height, rgb))

    def pole(self, x: float, y: float, height: float = 7.0) -> None:
        """Add a lamp post, of which little more than the shadow is visible."""
        self.box((x - 0.07, y - 0.07, x + 0.07, y + 0.07), height, (120, 120, 120))

    def wall(self, x0: float, y0: float, x1: float, y1: float, *, hedge: bool = False) -> None:
        """Add a garden wall or hedge between two points."""
        length = math.hypot(x1 - x0, y1 - y0)
        angle = math.atan2(y1 - y0, x1 - x0)
        if length < 0.5:
            return
        site = self.at(x0, y0, angle)
        if hedge:
            half = self.rng.uniform(0.4, 0.7)
            height = self.rng.uniform(1.4, 2.4)
            count = max(int(length / 0.8), 3)
            along = np.linspace(0, length, count)
            upper_y = half + self.rng.normal(0, 0.12, count)
            lower_y = -half + self.rng.normal(0, 0.12, count)
            upper = np.stack([along, upper_y], axis=1)
            lower = np.stack([along, lower_y], axis=1)
            green = jitter(self.rng, self._green(), 6, 0.06)
            outline = site.frame.points(np.vstack([upper, lower[::-1]]))
            self.world.boxes.append(Box(outline, height, green, leafy=True))
        else:
            site.box(
                (0, -0.13, length, 0.13),
                self.rng.uniform(1.0, 1.8),
                jitter(self.rng, (196, 190, 180), 8),
            )

    def _green(self) -> Rgb:
        red, green, blue = pick(self.rng, self.palette.leaves)
        return int(red * 0.88), int(green * 0.88), int(blue * 0.88)

    def tree(
        self, x: float, y: float, radius: float | None = None, *, conical: bool = False
    ) -> None:
        """Add a tree with its trunk at (x, y), unless that place is kept free."""
        rng = self.rng
        (centre,) = self.frame.points([(x, y)])
        if any(_within(centre, frame, rect) for frame, rect in self.kept_free):
            return
        if radius is None:
            radius = float(np.clip(rng.lognormal(0.85, 0.35), 1.0, 5.5))
        rgb = jitter(rng, pick(rng, self.palette.leaves), 10, 0.10)
        if rng.random() < 0.015:  # blossom or purple foliage
            rgb = jitter(rng, (128, 84, 104), 10)
        if conical:
            look = int(rng.integers(7, 9))
            slenderness = rng.uniform(3.2, 4.6)
        else:
            look = int(rng.integers(0, 7))
            slenderness = rng.uniform(1.5, 2.3)
        height = radius * slenderness + 0.8
        self.world.trees.append(
            Tree(
                float(centre[0]),
                float(centre[1]),
                radius=radius,
                height=float(height),
                rgb=rgb,
                look=look,
            )
        )

    def bush(self, x: float, y: float) -> None:
        """Add a shrub."""
        self.tree(x, y, self.rng.uniform(0.4, 1.1))

    def grove(self, rect: Rect, density: float) -> None:
        """Scatter trees over a rectangle, at a density per square metre."""
        x0, y0, x1, y1 = rect
        area = max(x1 - x0, 0) * max(y1 - y0, 0)
        for _ in range(self.rng.poisson(area * density)):
            self.tree(self.rng.uniform(x0, x1), self.rng.uniform(y0, y1))

    def roof(self, parts: tuple[Rect, ...], style: str, eaves: float, rgb: Rgb) -> None:
        """Add a building over one or two rectangles of its frame."""
        pitch = self.rng.uniform(0.32, 0.62)
        self.world.roofs.append(
            Roof(
                self.frame,
                parts,
                style=style,
                pitch=pitch,
                eaves=eaves,
                rgb=rgb,
                seed=int(self.rng.integers(2**31)),
            )
        )
        self.kept_free.extend(
            (self.frame, (x0 - 0.4, y0 - 0.4, x1 + 0.4, y1 + 0.4)) for x0, y0, x1, y1 in parts
        )
        area = sum((x1 - x0) * (y1 - y0) for x0, y0, x1, y1 in parts)
        if len(parts) == 2:
            (ax0, ay0, ax1, ay1), (bx0, by0, bx1, by1) = parts
            overlap_x = max(min(ax1, bx1) - max(ax0, bx0), 0)
            overlap_y = max(min(ay1, by1) - max(ay0, by0), 0)
            area -= overlap_x * overlap_y
        self.target("building", *(corners_of(part) for part in parts), area=area)

    def pool(self, x: float, y: float, angle: float = 0.0) -> None:
        """Add a swimming pool with its rim."""
        rng = self.rng
        site = self.at(x, y, angle)
        length = rng.uniform(6, 12)
        width = rng.uniform(3, 5)
        water_rgb: Rgb = (96, 182, 206) if rng.random() < 0.8 else (74, 150, 190)
        water = jitter(rng, water_rgb, 10, 0.06)
        rim = jitter(rng, (212, 200, 182), 8, 0.05)
        terrace = rng.uniform(0.8, 2.5)
        if rng.random() < 0.6:
            site.rect(
                (-length / 2 - terrace, -width / 2 - 1, length / 2 + 1, width / 2 + terrace),
                rim,
                Material.PAVING,
            )
        kind = rng.random()
        if kind < 0.7:
            outline = np.array(corners_of((-length / 2, -width / 2, length / 2, width / 2)))
        else:
            angles = np.linspace(0, 2 * np.pi, 48, endpoint=False)
            indent = 0.22 if kind > 0.85 else 0.0
            power = 2.6 if kind > 0.85 else 2.0
            waist = 1 - indent * np.exp(-(((angles - np.pi / 2) / 0.6) ** 2))
            cos = np.cos(angles)
            sin = np.sin(angles)
            # A superellipse in polar coordinates.
            inverse = np.abs(cos) ** power + np.abs(sin) ** power
            radial = inverse ** (-1 / power) * waist
            outline_x = length / 2 * radial * cos
            outline_y = width / 2 * radial * sin
            outline = np.stack([outline_x, outline_y], axis=1)
        grown = outline * (1 + 0.9 / np.array([length, width]))
        site.polygon(grown, (226, 222, 212), Material.PAVING)
        site.polygon(outline, water, Material.WATER)
        inner = outline * (1 - 0.7 / np.array([length, width]))
        red, green, blue = water
        deep = (int(red * 0.86), int(green * 0.96), int(blue * 1.0))
        site.polygon(inner, deep, Material.WATER)
        site.stain_rect((length * 0.1, -width * 0.4, length * 0.42, width * 0.4), 116)
        if kind < 0.7:
            site.rect(
                (-length / 2 + 0.1, -0.6, -length / 2 + 0.9, 0.6), (176, 214, 222), Material.WATER
            )
        site.target("swimming-pool", outline)
        self.kept_free.append(
            (site.frame, (-length / 2 - 0.8, -width / 2 - 0.8, length / 2 + 0.8, width / 2 + 0.8))
        )

    # Vehicles

    def vehicle(self, model: VehicleModel, x: float, y: float, angle: float) -> None:
        """Add a vehicle that points towards ``angle``."""
        (centre,) = self.frame.points([(x, y)])
        self.world.vehicles.append(
            PlacedVehicle(
                model, float(centre[0]), y=float(centre[1]), angle=self.frame.angle + angle
            )
        )


def _within(place: NDArray[np.float64], frame: Frame, rect: Rect) -> bool:
    dx = float(place[0]) - frame.x
    dy = float(place[1]) - frame.y
    cos = math.cos(frame.angle)
    sin = math.sin(frame.angle)
    x = dx * cos + dy * sin
    y = dy * cos - dx * sin
    return rect[0] < x < rect[2] and rect[1] < y < rect[3]


def _blob(
    rng: Generator, x: float, y: float, rx: float, ry: float, rough: float
) -> NDArray[np.float64]:
    angles = np.linspace(0, 2 * np.pi, 40, endpoint=False)
    radial = np.ones_like(angles)
    for order in range(2, 7):
        amplitude = rough * rng.normal() / order**0.7
        radial += amplitude * np.cos(order * angles + rng.uniform(0, 2 * np.pi))
    outline_x = x + rx * radial * np.cos(angles)
    outline_y = y + ry * radial * np.sin(angles)
    return np.stack([outline_x, outline_y], axis=1)
