"""Sprites of vehicles and tree crowns, which the painter scales and rotates.

A vehicle's sprite spans exactly its length and width. Its four channels, premultiplied by the
first, are coverage, visible share of the shaded paint, added grey (glass, tyres, lamps) and added
red (rear lamps). A crown's sprite spans [-1.25, 1.25] radii and has two channels: coverage and
light.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, cast

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

CROWN_SPAN = 1.25
# Transparent margin on every side of a vehicle's sprite, as a share of the length.
VEHICLE_PAD = 0.03

_Layer = NDArray[np.float32]
_Reals = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Sun:
    """Direction of the sunlight."""

    azimuth: float
    """Direction of shadows in the image, radians from +x towards +y."""
    elevation: float
    """Angle above the horizon, radians."""

    @classmethod
    def draw(cls, rng: Generator) -> Sun:
        """Draw a direction as on a day of clear shadows, 33 to 64 degrees above the horizon."""
        azimuth = rng.uniform(0, 2 * math.pi)
        elevation_deg = rng.uniform(33, 64)
        return cls(azimuth, math.radians(elevation_deg))

    def shadow(self, height: float) -> tuple[float, float]:
        """Compute the offset of the shadow of a point at this height."""
        reach = height / np.tan(self.elevation)
        return float(reach * np.cos(self.azimuth)), float(reach * np.sin(self.azimuth))

    def light(self, turn: float = 0.0) -> tuple[float, float, float]:
        """Compute the unit vector towards the sun in a frame rotated by ``turn``."""
        flat = -np.cos(self.elevation)
        angle = self.azimuth - turn
        return (
            float(flat * np.cos(angle)),
            float(flat * np.sin(angle)),
            float(np.sin(self.elevation)),
        )


@dataclass(frozen=True)
class _Car:
    """Shape of a car: positions along its length from the front, and half widths, as shares."""

    glass_front: float
    roof_front: float
    roof_rear: float
    glass_rear: float
    roof_half_width: float = 0.70
    bonnet: float = 0.86  # height of the leading edge, m
    boot: float = 1.0
    bed: bool = False
    bed_front: float = 0.655
    cabin_height: float = 1.45


# Half width of the greenhouse at its base, a share as in ``_Car``.
_BASE_HALF_WIDTH = 0.90

_CARS = {
    "city": _Car(0.17, 0.34, roof_rear=0.86, glass_rear=0.955, boot=0.9),
    "hatchback": _Car(0.24, 0.395, roof_rear=0.80, glass_rear=0.925, boot=0.9),
    "sedan": _Car(0.265, 0.415, roof_rear=0.66, glass_rear=0.80),
    "estate": _Car(0.26, 0.405, roof_rear=0.855, glass_rear=0.95, boot=0.9),
    "suv": _Car(
        0.255, 0.385, roof_rear=0.845, glass_rear=0.94, roof_half_width=0.73, bonnet=1.0, boot=1.0
    ),
    "van": _Car(
        0.10, 0.235, roof_rear=0.985, glass_rear=0.995, roof_half_width=0.84, bonnet=1.1, boot=1.2
    ),
    "pickup": _Car(
        0.27, 0.395, roof_rear=0.56, glass_rear=0.63, roof_half_width=0.73, bonnet=1.0, bed=True
    ),
    "kei": _Car(
        0.085,
        0.25,
        roof_rear=0.93,
        glass_rear=0.985,
        roof_half_width=0.82,
        bonnet=0.95,
        boot=1.3,
        cabin_height=1.75,
    ),
    "kei truck": _Car(
        0.03,
        0.15,
        roof_rear=0.34,
        glass_rear=0.40,
        roof_half_width=0.84,
        bonnet=1.1,
        bed=True,
        bed_front=0.425,
        cabin_height=1.75,
    ),
    "single cab": _Car(
        0.27,
        0.385,
        roof_rear=0.475,
        glass_rear=0.53,
        roof_half_width=0.74,
        bonnet=1.05,
        bed=True,
        bed_front=0.56,
        cabin_height=1.75,
    ),
    "crew cab": _Car(
        0.235,
        0.345,
        roof_rear=0.60,
        glass_rear=0.665,
        roof_half_width=0.75,
        bonnet=1.1,
        bed=True,
        bed_front=0.69,
        cabin_height=1.85,
    ),
    "flatbed": _Car(
        0.15,
        0.25,
        roof_rear=0.355,
        glass_rear=0.40,
        roof_half_width=0.80,
        bonnet=1.1,
        bed=True,
        bed_front=0.43,
        cabin_height=1.95,
    ),
    "minivan": _Car(
        0.16,
        0.32,
        roof_rear=0.90,
        glass_rear=0.97,
        roof_half_width=0.78,
        bonnet=1.0,
        boot=1.0,
        cabin_height=1.75,
    ),
}


def _soft(distance: _Layer, width: float) -> _Layer:
    """Convert a signed distance (positive inside) to coverage: a ramp one pixel wide."""
    return cast("_Layer", np.clip(distance / width + 0.5, 0, 1).astype(np.float32))


def _band(value: _Layer, low: float, high: float, width: float) -> _Layer:
    return cast("_Layer", _soft(value - low, width) * _soft(high - value, width))


def vehicle_sprite(
    body: str, length: float, width: float, px_per_m: float, light: tuple[float, float, float]
) -> _Layer:
    """Draw a vehicle that points to +x.

    Args:
        body: a body of the fleet.
        length: in metres; the outline touches exactly +-length / 2.
        width: in metres; the outline touches exactly +-width / 2.
        px_per_m: resolution.
        light: unit vector towards the sun, in the vehicle's frame.

    Returns:
        [rows, columns, 4]; see the module.
    """
    px = 1 / px_per_m
    pad = VEHICLE_PAD * length
    columns = max(8, round((length + 2 * pad) * px_per_m))
    rows = max(6, round((width + 2 * pad) * px_per_m))
    u_share = (np.arange(columns, dtype=np.float32) + 0.5) / columns - 0.5
    v_share = (np.arange(rows, dtype=np.float32) + 0.5) / rows - 0.5
    u = u_share * np.float32(length + 2 * pad)
    v = v_share * np.float32(width + 2 * pad)
    grid_u, grid_v = cast("tuple[_Layer, _Layer]", np.meshgrid(u, v))
    if body in _CARS:
        return _car(
            _CARS[body], body, u=grid_u, v=grid_v, length=length, width=width, px=px, light=light
        )
    return _heavy(body, grid_u, v=grid_v, length=length, width=width, px=px, light=light)


def _lit(height: _Layer, px: float, light: tuple[float, float, float]) -> _Layer:
    """Compute the Lambert shading of a height map; 1 for horizontal surfaces."""
    blur = max(0.05 / px, 0.4)
    height = cast("_Layer", cv2.GaussianBlur(height, (0, 0), blur, borderType=cv2.BORDER_REPLICATE))
    slope_v, slope_u = np.gradient(height, px)
    slope_u = np.clip(slope_u, -2, 2)
    slope_v = np.clip(slope_v, -2, 2)
    light_x, light_y, light_z = light
    normal_length = np.sqrt(1 + slope_u**2 + slope_v**2)
    lambert = (light_z - light_x * slope_u - light_y * slope_v) / normal_length
    ambient = 0.45
    shade = ambient + (1 - ambient) * lambert / light_z
    return cast("_Layer", np.clip(shade, 0.38, 1.35).astype(np.float32))


def _car(
    car: _Car,
    body: str,
    u: _Layer,
    v: _Layer,
    length: float,
    width: float,
    px: float,
    light: tuple[float, float, float],
) -> _Layer:
    half_width = width / 2
    t = (length / 2 - u) / length
    across = np.abs(v) / half_width
    inset = _car_inset(body, u, v=v, t=t, across=across, length=length, width=width)
    cover = _soft(inset, px)

    # Greenhouse: almost as wide as the body at its base, narrower at the roof.
    base_front = car.glass_front - 0.025 * (1 - np.clip(across, 0, 1) ** 2)
    rise = np.minimum((t - base_front) / (car.roof_front - car.glass_front), 1.0)
    fall = np.minimum((car.glass_rear - t) / max(car.glass_rear - car.roof_rear, 0.01), 1.0)
    cabin = np.clip(np.minimum(rise, fall), 0, 1)
    lean = np.clip((_BASE_HALF_WIDTH - across) / (_BASE_HALF_WIDTH - car.roof_half_width), 0, 1)
    belt = car.bonnet + (car.boot - car.bonnet) * np.clip(t, 0, 1)
    roof_height = {"van": 2.1, "suv": 1.65}.get(body, car.cabin_height)
    crown = 0.05 * (1 - np.clip(across, 0, 1) ** 2)
    edge = np.clip(inset / 0.22, 0, 1)
    body_height = belt * (0.55 + 0.45 * np.sqrt(edge))
    cabin_height = (roof_height - belt) * np.minimum(cabin, lean)
    height = body_height + crown + cabin_height
    shade = _lit(height.astype(np.float32), px, light)

    glass = _car_glass(
        car, t, across=across, base_front=base_front, length=length, half_width=half_width, px=px
    )
    if body == "van":
        glass *= 1 - _soft(((t - 0.30) * length).astype(np.float32), px)
    paint = shade * (1 - glass)
    # Windscreens reflect the sky: brighter towards the roof.
    sky = 26 * np.clip(rise, 0, 1) * (t < 0.5)
    grey = glass * (38 + sky + 14 * (shade - 0.8))
    if car.bed:
        along_bed = _band(t * length, car.bed_front * length, high=0.965 * length, width=px)
        from_side = (0.80 - across) * half_width
        bed = along_bed * _soft(from_side.astype(np.float32), px)
        paint *= 1 - 0.85 * bed
        grey += 26 * bed * (1 - glass)
    from_gloss = (v / half_width) - 0.35 * np.sign(-light[1] or 1.0)
    gloss = np.exp(-(from_gloss**2) / 0.05) * np.clip(edge, 0, 1) * (1 - glass)
    grey += 11 * gloss  # along bonnet and roof
    red = _car_trim(
        car, paint, grey=grey, t=t, across=across, length=length, half_width=half_width, px=px
    )
    channels = [cover, paint * cover, grey * cover, red * cover]
    return cast("_Layer", np.stack(channels, axis=2).astype(np.float32))


def _car_inset(
    body: str, u: _Layer, v: _Layer, t: _Layer, across: _Reals, length: float, width: float
) -> _Layer:
    """Compute the distance inside the outline, metres; front and rear are rounded and narrower."""
    half_length = length / 2
    half_width = width / 2
    rounding = 0.10 * width if body == "van" else 0.17 * width
    front = half_length - rounding * np.clip(across, 0, 1.2) ** 3.5
    rear = half_length - 0.5 * rounding * np.clip(across, 0, 1.2) ** 4
    front_taper = 0.07 * np.clip((0.16 - t) / 0.16, 0, 1) ** 2
    rear_taper = 0.04 * np.clip((t - 0.88) / 0.12, 0, 1) ** 2
    side = half_width * (1 - front_taper - rear_taper)
    from_ends = np.minimum(front - u, u + rear)
    from_sides = side - np.abs(v)
    return cast("_Layer", np.minimum(from_ends, from_sides).astype(np.float32))


def _car_glass(
    car: _Car,
    t: _Layer,
    across: _Reals,
    base_front: _Reals,
    length: float,
    half_width: float,
    px: float,
) -> _Layer:
    """Compute the share of glass: windscreen, rear window, and side windows between pillars."""
    base_half = _BASE_HALF_WIDTH
    roof_half = car.roof_half_width
    in_cabin = _soft(
        (
            np.minimum(
                np.minimum(t - base_front, car.glass_rear - t) * length,
                (base_half - across) * half_width,
            )
        ).astype(np.float32),
        px,
    )
    taper = (
        roof_half
        + 0.06 * np.clip((car.roof_front - t) / 0.1, 0, 1)
        + 0.04 * np.clip((t - car.roof_rear) / 0.1, 0, 1)
    )
    on_roof = _soft(
        np.minimum(
            np.minimum(t - car.roof_front, car.roof_rear - t) * length,
            (roof_half - across) * half_width,
        ).astype(np.float32),
        px,
    )
    screen = (
        in_cabin * _soft(((taper - across) * half_width).astype(np.float32), px) * (1 - on_roof)
    )
    sides = in_cabin * _soft(((across - roof_half - 0.02) * half_width).astype(np.float32), px)
    sides *= _soft(((0.885 - across) * half_width).astype(np.float32), px) * _band(
        t * length,
        (car.roof_front - 0.07) * length,
        high=(min(car.roof_rear + 0.05, 0.97)) * length,
        width=px,
    )
    pillar = (car.roof_front * 0.45 + car.roof_rear * 0.55) * length
    pillars = _band(t * length, pillar - 0.06, high=pillar + 0.06, width=px)
    return cast("_Layer", np.clip(screen + sides * (1 - pillars), 0, 1))


def _car_trim(
    car: _Car,
    paint: _Reals,
    grey: _Reals,
    t: _Layer,
    across: _Reals,
    length: float,
    half_width: float,
    px: float,
) -> _Reals:
    """Draw seams, grille and lamps into ``paint`` and ``grey``; return the red of rear lamps."""
    seam = _band(
        t * length, car.glass_front * length - 0.10, high=car.glass_front * length - 0.05, width=px
    )
    paint *= 1 - 0.35 * seam * _soft(((0.86 - across) * half_width).astype(np.float32), px)
    grille = _band(t * length, 0.0, high=0.07, width=px) * _soft(
        ((0.55 - across) * half_width).astype(np.float32), px
    )
    paint *= 1 - 0.55 * grille
    lamp_side = _soft(((across - 0.60) * half_width).astype(np.float32), px)
    lamps = _band(t * length, 0.06, high=0.30, width=px) * lamp_side * (across < 0.97)
    paint *= 1 - 0.7 * lamps
    grey += 120 * lamps
    rear_lamps = _band(t * length, length - 0.20, high=length - 0.03, width=px) * lamp_side
    paint *= 1 - 0.75 * rear_lamps
    return 110 * rear_lamps


def _heavy(
    body: str,
    u: _Layer,
    v: _Layer,
    length: float,
    width: float,
    px: float,
    light: tuple[float, float, float],
) -> _Layer:
    half_length = length / 2
    half_width = width / 2
    rounding = 0.10 if body in ("truck", "semitrailer") else 0.30
    corner_u = np.maximum(np.abs(u) - (half_length - rounding), 0)
    corner_v = np.maximum(np.abs(v) - (half_width - rounding), 0)
    box = np.minimum(half_length - np.abs(u), half_width - np.abs(v))
    inset = np.where(
        (corner_u > 0) & (corner_v > 0), rounding - np.hypot(corner_u, corner_v), box
    ).astype(np.float32)
    cover = _soft(inset, px)
    from_front = (half_length - u).astype(np.float32)
    height = (3.0 * np.sqrt(np.clip(inset / 0.25, 0, 1))).astype(np.float32)
    inner = _soft((half_width - 0.25 - np.abs(v)).astype(np.float32), px)
    grey = np.zeros_like(cover)
    dark = np.zeros_like(cover)
    if body in ("truck", "semitrailer"):
        cab = 2.1
        gap = _band(from_front, cab, high=cab + (0.35 if body == "truck" else 0.8), width=px)
        dark = np.maximum(gap, _band(from_front, 0.12, high=0.45, width=px) * inner * 0.85)
        height -= (1.0 * _soft((cab - from_front).astype(np.float32), px)).astype(np.float32)
        ribs = (np.floor(from_front / 1.2) % 2).astype(np.float32)
        grey += 4 * ribs * (from_front > cab + 0.8)
    elif body == "bus":
        dark = _band(from_front, 0.05, high=0.35, width=px) * inner * 0.8
        for centre in (0.22, 0.55, 0.8):
            hatch = _band(from_front, centre * length - 0.45, high=centre * length + 0.45, width=px)
            hatch *= _soft((0.42 - np.abs(v)).astype(np.float32), px)
            dark = np.maximum(dark, 0.25 * hatch)
        unit = _band(from_front, 0.33 * length, high=0.33 * length + 2.2, width=px)
        unit *= _soft((0.8 - np.abs(v)).astype(np.float32), px)
        height += (0.3 * unit).astype(np.float32)
        grey += 14 * unit
    else:
        for centre in (0.25, 0.5, 0.72):
            dark = np.maximum(
                dark,
                0.7
                * _band(from_front, centre * length - 0.3, high=centre * length + 0.3, width=px)
                * _soft((0.3 - np.abs(v)).astype(np.float32), px),
            )
    shade = _lit(height, px, light)
    paint = shade * (1 - dark)
    grey = grey + 34 * dark
    return cast(
        "_Layer",
        np.stack([cover, paint * cover, grey * cover, 0 * cover], axis=2).astype(np.float32),
    )


def crown_sprite(rng: Generator, size: int, sun: Sun, *, conical: bool = False) -> _Layer:
    """Draw a crown of leaf clusters in sunlight.

    Args:
        rng: random generator of the clusters.
        size: rows and columns.
        sun: direction of the light.
        conical: whether the tree is a conifer or cypress.

    Returns:
        [size, size, 2]; see the module.
    """
    axis = (((np.arange(size) + 0.5) / size * 2 - 1) * CROWN_SPAN).astype(np.float32)
    height = np.full((size, size), -1.0, dtype=np.float32)
    count = 150
    lobes = 1 + 0.10 * rng.standard_normal(4)
    phases = rng.uniform(0, 2 * np.pi, 4)
    for _ in range(count):
        distance = np.sqrt(rng.uniform(0, 1))
        angle = rng.uniform(0, 2 * np.pi)
        reach = 0.90 * (
            1 + sum(0.09 * lobes[n] * np.cos((n + 2) * angle + phases[n]) for n in range(4))
        )
        radius = rng.uniform(0.10, 0.24) * (0.7 if conical else 1.0)
        x = reach * (1 - radius * 0.6) * distance * np.cos(angle)
        y = reach * (1 - radius * 0.6) * distance * np.sin(angle)
        level = (
            1.6 * (1 - distance) if conical else 0.85 * np.sqrt(max(0.0, 1 - 0.85 * distance**2))
        )
        level += rng.normal(0, 0.06)
        columns = slice(*np.searchsorted(axis, (x - radius, x + radius)))
        rows = slice(*np.searchsorted(axis, (y - radius, y + radius)))
        squared = radius**2 - (axis[None, columns] - x) ** 2 - (axis[rows, None] - y) ** 2
        cluster = np.where(squared > 0, level + np.sqrt(np.maximum(squared, 0)) - radius, -1)
        height[rows, columns] = np.maximum(height[rows, columns], cluster)
    inside = (height > -1).astype(np.float32)
    leaves = rng.standard_normal((size, size)).astype(np.float32)
    leaves = cast(
        "_Layer",
        cv2.GaussianBlur(leaves, (0, 0), max(0.6, 0.014 * size), borderType=cv2.BORDER_REPLICATE),
    )
    leaves /= leaves.std()
    surface = np.where(inside > 0, height, -0.3).astype(np.float32) + 0.018 * leaves
    step = float(axis[1] - axis[0])
    light = sun.light()
    slope_y, slope_x = np.gradient(cv2.GaussianBlur(surface, (0, 0), max(0.5, size / 110)), step)
    slope_x = np.clip(slope_x, -2.5, 2.5)
    slope_y = np.clip(slope_y, -2.5, 2.5)
    lambert = (light[2] - light[0] * slope_x - light[1] * slope_y) / np.sqrt(
        1 + slope_x**2 + slope_y**2
    )
    # Clusters cast shadows on those behind them.
    lit = np.ones_like(surface)
    rise = np.tan(sun.elevation)
    for distance in (0.06, 0.12, 0.2, 0.3, 0.42):
        dx = light[0] / np.cos(sun.elevation) * distance
        dy = light[1] / np.cos(sun.elevation) * distance
        blocker = np.roll(surface, (-round(dy / step), -round(dx / step)), axis=(0, 1))
        lit = np.minimum(lit, np.clip(1 - (blocker - surface - distance * rise) / 0.10, 0, 1))
    depth = np.clip((surface + 0.1) / 0.9, 0, 1)
    value = (0.34 + 0.26 * depth) + 0.62 * np.clip(lambert, 0, 1) * lit
    value = value * (1 + 0.09 * leaves)
    cover = cast("_Layer", cv2.GaussianBlur(inside, (0, 0), max(0.5, size / 160)))
    return cast(
        "_Layer", np.stack([cover, np.clip(value, 0.15, 1.5) * cover], axis=2).astype(np.float32)
    )
