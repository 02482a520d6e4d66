"""Composited shapes: an outline with its own surface, pasted on a real background.

They teach "the closed thing that touches the sides of the box" beyond the two categories with real
masks: irregular roofs, blobs, discs with rings, stadium ovals, rows of panels, with aprons, shadows
and look-alikes around them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import cv2
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.random import Generator
    from numpy.typing import NDArray

    Picture: TypeAlias = NDArray[np.uint8]
    """RGB picture ``[h, w, 3]``."""

    Polygon: TypeAlias = NDArray[np.float64]
    """Corners x, y ``[n, 2]`` in pixels."""

    Point: TypeAlias = NDArray[np.float64]
    """Point x, y ``[2]`` in pixels."""

    Coverage: TypeAlias = NDArray[np.float32]
    """Coverage ``[h, w]`` in 0..1."""

    Surface: TypeAlias = NDArray[np.float32]
    """Colours ``[h, w, 3]`` in 0..255."""

    Colour: TypeAlias = NDArray[np.float32]
    """Colour ``[3]`` in 0..255."""

    Coordinates: TypeAlias = NDArray[np.float64]
    """Coordinate ``[h, w]`` of each pixel."""

# Outlines are drawn at twice the resolution and reduced, which makes their edges soft.
_FINE = 2
# Fractional bits of OpenCV's drawing coordinates.
_SHIFT = 4
# Grey levels between the shape and its surroundings.
_MIN_CONTRAST = 14.0


def _turned(points: Polygon, rng: Generator) -> Polygon:
    angle = rng.uniform(0, 2 * np.pi)
    cos = np.cos(angle)
    sin = np.sin(angle)
    out: Polygon = points @ np.array([[cos, -sin], [sin, cos]])
    return out


def _rectangle(wide: float, high: float) -> Polygon:
    x = [-wide, wide, wide, -wide]
    y = [-high, -high, high, high]
    return np.column_stack([x, y])


def _ellipse(wide: float, high: float, power: float = 2.0) -> Polygon:
    t = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    cos = np.cos(t)
    sin = np.sin(t)
    # A superellipse: powers above 2 are closer to a rectangle.
    x = wide * np.sign(cos) * np.abs(cos) ** (2 / power)
    y = high * np.sign(sin) * np.abs(sin) ** (2 / power)
    return np.column_stack([x, y])


def _outline(rng: Generator) -> list[Polygon]:
    """Draw polygons, whose union is the shape, of about unit half size, not yet turned."""
    kind = rng.choice(7, p=(0.22, 0.14, 0.16, 0.12, 0.12, 0.12, 0.12))
    ratio = rng.uniform(0.3, 1.0)
    if kind == 0:
        # Wings of a building.
        parts = [_rectangle(1.0, ratio)]
        for _ in range(rng.integers(0, 3)):
            wing = _rectangle(rng.uniform(0.2, 0.6), rng.uniform(0.2, 0.6))
            wing_x = rng.uniform(-0.8, 0.8)
            wing_y = rng.choice([-1, 1]) * ratio
            parts.append(wing + np.array([wing_x, wing_y]))
        return parts
    if kind == 1:
        # A blob: a circle with random harmonics.
        t = np.linspace(0, 2 * np.pi, 72, endpoint=False)
        radius = np.ones_like(t)
        for order in range(2, 6):
            amplitude = rng.normal(0, 0.32 / order)
            radius += amplitude * np.cos(order * t + rng.uniform(0, 2 * np.pi))
        radius = np.maximum(radius, 0.25)
        x = radius * np.cos(t)
        y = ratio * radius * np.sin(t)
        return [np.column_stack([x, y])]
    if kind == 2:
        # A tank or roundabout.
        return [_ellipse(1.0, 1.0)]
    if kind == 3:
        # An oval, or nearly a rectangle with round corners.
        return [_ellipse(1.0, ratio, float(rng.choice([2.0, 4.0])))]
    if kind == 4:
        # A running track.
        shift = np.array([1.0 - ratio, 0.0])
        end = _ellipse(ratio, ratio)
        return [_rectangle(1.0 - ratio, ratio), end + shift, end - shift]
    if kind == 5:
        # Any convex polygon of four to seven corners.
        t = np.sort(rng.uniform(0, 2 * np.pi, rng.integers(4, 8)))
        return [np.column_stack([np.cos(t), np.sin(t)])]
    return [_rectangle(1.0, ratio)]


def _filled(polygons: list[Polygon], side: int) -> Coverage:
    fine = np.zeros((side * _FINE, side * _FINE), np.uint8)
    for polygon in polygons:
        scaled = np.round((polygon * _FINE - 0.5) * 2**_SHIFT)
        cv2.fillPoly(fine, [scaled.astype(np.int32)], 255, shift=_SHIFT)
    coarse = cv2.resize(fine, (side, side), interpolation=cv2.INTER_AREA)
    out: Coverage = np.divide(coarse, 255.0, dtype=np.float32)
    return out


def _colour(rng: Generator) -> Colour:
    level = rng.uniform(15, 240)
    colour: NDArray[np.float64] = level + rng.normal(0, 1, 3) * rng.choice([8.0, 45.0])
    return np.clip(colour, 0, 255).astype(np.float32)


def _surface(rng: Generator, texture: Picture, polygons: list[Polygon]) -> Surface:
    """Draw a shape's surface: a colour or real texture, then ridges, a grid, rings or stripes."""
    side = texture.shape[0]
    surface: NDArray[np.floating] = _base(rng, texture)
    centre, size, u, v = _own_axes(rng, side, polygons)
    # Two slopes, one of them in the light.
    if rng.random() < 0.35:
        is_lit = v > rng.normal(0, 0.05) * size
        shade = np.float32(rng.uniform(0.65, 0.92))
        surface = np.where(is_lit[:, :, None], surface, surface * shade)
    draw = rng.random()
    if draw < 0.22:
        # The joints of panels or tiles.
        pitch_u, pitch_v = rng.uniform(3, 14, 2)
        joint_u = (u % pitch_u) < rng.uniform(0.8, 1.8)
        joint_v = (v % pitch_v) < rng.uniform(0.8, 1.8)
        step = np.float32(rng.uniform(-50, 70))
        is_joint = joint_u | joint_v
        surface = np.where(is_joint[:, :, None], surface + step, surface)
    elif draw < 0.37:
        # Corrugation or markings.
        height = np.float32(rng.uniform(5, 30))
        waves = np.sin(2 * np.pi * v / rng.uniform(3, 16))
        surface = surface + height * waves[:, :, None]
    elif draw < 0.62:
        # An inner shape: an island, an infield, roof lights.
        inner = [(polygon - centre) * rng.uniform(0.3, 0.85) + centre for polygon in polygons]
        change = _filled(inner, side)[:, :, None] * (_colour(rng) - surface)
        surface = surface + change * np.float32(rng.uniform(0.4, 1.0))
    # Brightness that changes along the shape.
    if rng.random() < 0.3:
        slope = np.float32(rng.uniform(-0.3, 0.3) / size)
        surface = surface * (1 + slope * u[:, :, None])
    return surface.astype(np.float32)


def _base(rng: Generator, texture: Picture) -> Surface:
    """Draw a real texture of another brightness, or a colour with a little texture."""
    grain = texture.astype(np.float32)
    if rng.random() < 0.35:
        gain = np.float32(rng.uniform(0.7, 1.2))
        return grain * gain + rng.normal(0, 15, 3).astype(np.float32)
    grain -= grain.mean(axis=(0, 1))
    return _colour(rng) + grain * np.float32(rng.uniform(0.0, 0.35))


def _own_axes(
    rng: Generator, side: int, polygons: list[Polygon]
) -> tuple[Point, float, Coordinates, Coordinates]:
    """Compute a shape's centre and size, and each pixel's coordinates along and across it.

    The axis follows the first edge of a polygon; a curve has none, so its axis is random.
    """
    rows, columns = np.mgrid[0:side, 0:side].astype(np.float32)
    corners = np.concatenate(polygons)
    centre = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    size = float(np.ptp(corners, axis=0).max())
    first = polygons[0]
    edge = first[1] - first[0] if len(first) < 10 else rng.normal(0, 1, 2)
    along = edge / max(1e-6, float(np.hypot(*edge)))
    x = columns - centre[0]
    y = rows - centre[1]
    u = x * along[0] + y * along[1]
    v = -x * along[1] + y * along[0]
    return centre, size, u, v


def _placed(rng: Generator, length_px: float, focus: Point) -> list[Polygon]:
    """Draw an outline, turned, at its size and position."""
    outline = _outline(rng)
    turned = _turned(np.concatenate(outline), rng)
    ends = np.cumsum([len(polygon) for polygon in outline])
    parts = np.split(turned, ends[:-1])
    middle = 0.5 * (turned.min(axis=0) + turned.max(axis=0))
    scale = length_px / np.ptp(turned, axis=0).max()
    return [(polygon - middle) * scale + focus for polygon in parts]


def composite(
    rng: Generator,
    background: Picture,
    texture: Callable[[], Picture],
    length_px: float,
    focus: Point,
) -> tuple[Picture, Coverage]:
    """Paste a shape whose longer side is about ``length_px`` at ``focus``, with company.

    Args:
        rng: the only source of chance.
        background: ``[side, side, 3]``.
        texture: draws surfaces of the background's size.
        length_px: longer side of the shape's bounding box.
        focus: x, y of its centre.

    Returns:
        The image and the shape's coverage ``[side, side]`` in 0..1.
    """
    side = background.shape[0]
    image = background.astype(np.float32)
    placed = _placed(rng, length_px, focus)
    mask = _filled(placed, side)
    shadow = rng.uniform(-0.12, 0.12, 2) * length_px
    dark = np.float32(rng.uniform(0.35, 0.75))
    soft = rng.uniform(0.4, 1.2)

    def paste(polygons: list[Polygon], cover: Coverage, *, has_shadow: bool) -> None:
        nonlocal image
        if has_shadow:
            shaded = _filled([polygon + shadow for polygon in polygons], side)
            image = image * (1 - shaded[:, :, None] * (1 - dark))
        drawn = _surface(rng, texture(), polygons)
        surface = _with_contrast(drawn, cover, image)
        edge = cv2.GaussianBlur(cover, (0, 0), soft)[:, :, None]
        image = image + edge * (surface - image)

    # An apron around the shape, the roof under panels, a kerb.
    if rng.random() < 0.3:
        apron = []
        for polygon in placed:
            larger = (polygon - focus) * rng.uniform(1.15, 1.7) + focus
            apron.append(larger + rng.normal(0, 0.04, 2) * length_px)
        cover = _filled(apron, side)
        paste(apron, cover, has_shadow=rng.random() < 0.5)
    # Neighbours, alike or not, that the shape covers in part.
    for _ in range(rng.integers(0, 4)):
        angle = rng.uniform(0, 2 * np.pi)
        direction = np.array([np.cos(angle), np.sin(angle)])
        shift = direction * length_px * rng.uniform(0.75, 1.4)
        neighbour = [
            (polygon - focus) * rng.uniform(0.4, 1.0) + focus + shift for polygon in placed
        ]
        cover = _filled(neighbour, side)
        paste(neighbour, cover, has_shadow=rng.random() < 0.5)
    paste(placed, mask, has_shadow=rng.random() < 0.6)
    # The shadow of something else across the shape.
    if rng.random() < 0.25:
        half_width = rng.uniform(0.1, 0.4) * length_px
        strip = _turned(_rectangle(length_px, half_width), rng)
        moved = strip + focus + rng.uniform(-0.6, 0.6, 2) * length_px
        strip_cover = _filled([moved], side)
        across = cv2.GaussianBlur(strip_cover, (0, 0), 1.0)
        image = image * (1 - across[:, :, None] * (1 - dark))
    return np.clip(image + 0.5, 0, 255).astype(np.uint8), mask


def _with_contrast(surface: Surface, cover: Coverage, image: Surface) -> Surface:
    """Brighten or darken a surface that is hardly visible against its surroundings."""
    inside = cover > 0.5
    square = np.ones((7, 7), np.uint8)
    grown = cv2.dilate(inside.astype(np.uint8), square)
    ring = grown.astype(bool) & ~inside
    if not inside.any() or not ring.any():
        return surface
    gap = surface[inside].mean(axis=0) - image[ring].mean(axis=0)
    contrast = float(np.abs(gap).mean())
    if contrast >= _MIN_CONTRAST:
        return surface
    sign = 1.0 if gap.mean() >= 0 else -1.0
    return surface + (_MIN_CONTRAST - contrast) * sign
