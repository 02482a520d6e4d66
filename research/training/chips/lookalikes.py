"""Objects that detectors confuse with cars, such as sheds, benches, skylights, boats and shadows.

Each function draws an object on a canvas in place, and returns its length and width in metres. The
object lies in the canvas's middle, with its axis along the columns.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from research.scenes.sprites import Sun, crown_sprite

Canvas = NDArray[np.float32]
# Corners x, y [n, 2] in pixels of a canvas.
Outline = NDArray[np.float64]
# Length and width of a drawn object, metres.
Size = tuple[float, float]
Draw = Callable[[Generator, Canvas, float, Sun], Size]
# Fractional bits of OpenCV's coordinates.
_SHIFT = 4


def _corners(
    canvas: Canvas, px_per_m: float, length: float, width: float, *, x: float = 0.0, y: float = 0.0
) -> Outline:
    """Compute the corners of a rectangle, pixels; sizes and offset from the middle in metres."""
    half = np.array([length, width]) / 2
    middle = _middle(canvas) + np.array([x, y]) * px_per_m
    square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    return middle + square * half * px_per_m


def _middle(canvas: Canvas) -> NDArray[np.float64]:
    """Compute the middle ``[2]`` of a canvas, pixels."""
    return np.array(canvas.shape[1::-1]) / 2


def fill(canvas: Canvas, points: Outline, colour: NDArray[np.floating]) -> None:
    """Fill a polygon of pixels with a colour."""
    rgb = [float(channel) for channel in colour]
    cv2.fillPoly(canvas, [_fixed_point(points)], rgb, cv2.LINE_AA, _SHIFT)


def _fixed_point(points: Outline) -> NDArray[np.int32]:
    """Convert pixels to OpenCV's fixed-point coordinates, where integers are pixel centres."""
    return np.asarray(np.round((points - 0.5) * (1 << _SHIFT)), np.int32)


def shade(canvas: Canvas, points: Outline, height_px: float, sun: Sun, strength: float) -> None:
    """Darken the shadow of an object of this height with the convex outline ``points``."""
    both = np.vstack([points, points + sun.shadow(height_px)])
    hull = cv2.convexHull(both.astype(np.float32))
    shadow = hull.reshape(-1, 2).astype(np.float64)
    cover = np.zeros(canvas.shape[:2], np.float32)
    cv2.fillPoly(cover, [_fixed_point(shadow)], 1.0, cv2.LINE_AA, _SHIFT)
    cover = np.asarray(cv2.GaussianBlur(cover, (0, 0), 0.8), np.float32)
    tint = np.array([0.40, 0.44, 0.52], np.float32)
    canvas *= 1 - strength * cover[:, :, None] * (1 - tint)


def colour_of(rng: Generator) -> NDArray[np.float64]:
    """Draw a colour: mostly grey, sometimes any."""
    grey = rng.uniform(20, 245)
    spread = 8 if rng.random() < 0.7 else 45
    return np.clip(grey + rng.normal(0, spread, 3), 5, 250)


def draw_box(rng: Generator, canvas: Canvas, px_per_m: float, sun: Sun) -> Size:
    """Draw a shed, crate or container: plain, ridged, ribbed or framed."""
    length = rng.uniform(1.2, 7.0)
    width = length * rng.uniform(0.3, 0.95)
    points = _corners(canvas, px_per_m, length, width)
    colour = colour_of(rng)
    height_px = px_per_m * rng.uniform(0.4, 2.8)
    strength = rng.uniform(0.5, 1.0)
    shade(canvas, points, height_px=height_px, sun=sun, strength=strength)
    fill(canvas, points, colour)
    kind = rng.integers(5)
    if kind == 0:
        # A ridge: one side lies in the light.
        side = _corners(canvas, px_per_m, length, width / 2, y=width / 4)
        fill(canvas, side, colour * rng.uniform(0.55, 0.9))
    elif kind == 1:
        count = int(rng.integers(4, 16))
        for k in range(count):
            x = (k + 0.5) * length / count - length / 2
            rib = _corners(canvas, px_per_m, length / count / 2, width, x=x)
            fill(canvas, rib, colour * rng.uniform(0.7, 0.95))
    elif kind == 2:
        lid = _corners(canvas, px_per_m, 0.85 * length, 0.75 * width)
        fill(canvas, lid, colour_of(rng))
    elif kind == 3:
        share = rng.uniform(0.2, 0.6)
        end = _corners(canvas, px_per_m, share * length, width, x=(1 - share) * length / 2)
        fill(canvas, end, colour_of(rng))
    return length, width


def draw_air_conditioner(rng: Generator, canvas: Canvas, px_per_m: float, sun: Sun) -> Size:
    """Draw a grey box with dark fans."""
    length = rng.uniform(1.5, 6.5)
    width = length * rng.uniform(0.35, 0.8)
    points = _corners(canvas, px_per_m, length, width)
    colour = np.full(3, rng.uniform(110, 235))
    height_px = px_per_m * rng.uniform(0.6, 2.0)
    strength = rng.uniform(0.6, 1.0)
    shade(canvas, points, height_px=height_px, sun=sun, strength=strength)
    fill(canvas, points, colour)
    fans = int(rng.integers(1, 5))
    radius = 0.42 * min(width, length / fans)
    for k in range(fans):
        x = (k + 0.5) * length / fans - length / 2
        middle = _middle(canvas) + np.array([x * px_per_m, 0.0])
        ring = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        circle = np.column_stack([np.cos(ring), np.sin(ring)]) * px_per_m
        fill(canvas, middle + radius * circle, colour * rng.uniform(0.2, 0.6))
        fill(canvas, middle + 0.3 * radius * circle, colour * 0.9)
    return length, width


def draw_row(rng: Generator, canvas: Canvas, px_per_m: float, sun: Sun) -> Size:
    """Draw one of a row of equal objects: graves, bee hives, solar panels, benches, bays."""
    length = rng.uniform(1.6, 5.5)
    width = rng.uniform(0.7, 2.3)
    pitch = width * rng.uniform(1.15, 1.8)
    colour = colour_of(rng)
    inner = colour_of(rng)
    height = px_per_m * rng.uniform(0.2, 1.0)
    for k in range(-6, 7):
        if k and rng.random() < 0.15:
            continue
        points = _corners(canvas, px_per_m, length, width, y=k * pitch)
        shade(canvas, points, height_px=height, sun=sun, strength=0.8)
        fill(canvas, points, colour)
        middle = _corners(canvas, px_per_m, 0.8 * length, 0.65 * width, y=k * pitch)
        fill(canvas, middle, inner)
    return length, width


def draw_bench(rng: Generator, canvas: Canvas, px_per_m: float, sun: Sun) -> Size:
    """Draw a slatted bench, two that face each other, or a table between two benches."""
    length = rng.uniform(1.3, 2.6)
    seat = rng.uniform(0.3, 0.55)
    kind = rng.integers(3)
    colour = colour_of(rng)
    height = px_per_m * rng.uniform(0.4, 0.9)
    table = rng.uniform(0.6, 1.0)
    # Middle and depth of each piece, across the canvas.
    if kind == 0:
        pieces = [(0.0, seat)]
        depth = seat
    else:
        between = rng.uniform(0.1, 0.9) if kind == 1 else table + 0.1
        distance = seat + between
        pieces = [(-distance / 2, seat), (distance / 2, seat)]
        depth = distance + seat
    if kind == 2:
        pieces.append((0.0, table))
    slats = int(rng.integers(2, 5))
    for y, width in pieces:
        outline = _corners(canvas, px_per_m, length, width, y=y)
        strength = rng.uniform(0.6, 1.05)
        shade(canvas, outline, height_px=height, sun=sun, strength=strength)
        fill(canvas, outline, colour * rng.uniform(0.3, 0.7))
        for k in range(slats):
            middle = y + ((k + 0.5) / slats - 0.5) * width
            slat = _corners(canvas, px_per_m, length, 0.7 * width / slats, y=middle)
            fill(canvas, slat, colour)
    if kind == 0 and rng.random() < 0.6:
        back = _corners(canvas, px_per_m, length, 0.12, y=-seat / 2)
        fill(canvas, back, colour * rng.uniform(0.5, 1.0))
    return length, depth


def draw_playground(rng: Generator, canvas: Canvas, px_per_m: float, sun: Sun) -> Size:
    """Draw a swing, seesaw or exercise machine of coloured bars, often on a round mat."""
    length = rng.uniform(1.2, 3.5)
    width = length * rng.uniform(0.3, 0.7)
    middle = _middle(canvas)
    if rng.random() < 0.7:
        ring = np.linspace(0, 2 * np.pi, 32, endpoint=False)
        radius = px_per_m * length * rng.uniform(0.5, 0.9)
        mat = middle + radius * np.column_stack([np.cos(ring), np.sin(ring)])
        fill(canvas, mat, colour_of(rng))
    for _ in range(rng.integers(3, 8)):
        # Bars lie along or across, and move only at a right angle to themselves.
        if rng.random() < 0.4:
            size = (rng.uniform(0.15, 0.5), width)
            direction = (1, 0)
        else:
            size = (length, rng.uniform(0.1, 0.4))
            direction = (0, 1)
        x, y = rng.uniform(-0.4, 0.4, 2) * (length, width) * direction
        points = _corners(canvas, px_per_m, *size, x=float(x), y=float(y))
        height_px = px_per_m * rng.uniform(0.3, 1.5)
        strength = rng.uniform(0.5, 1.0)
        shade(canvas, points, height_px=height_px, sun=sun, strength=strength)
        fill(canvas, points, rng.uniform(20, 250, 3))
    return length, width


def draw_skylight(rng: Generator, canvas: Canvas, px_per_m: float, sun: Sun) -> Size:
    """Draw glass in a light frame on a roof of one colour."""
    roof = colour_of(rng)
    canvas[:] = 0.25 * canvas + 0.75 * roof.astype(np.float32)
    length = rng.uniform(1.2, 5.0)
    width = length * rng.uniform(0.35, 0.8)
    points = _corners(canvas, px_per_m, length, width)
    height_px = px_per_m * rng.uniform(0.1, 0.9)
    shade(canvas, points, height_px=height_px, sun=sun, strength=0.9)
    fill(canvas, points, np.full(3, rng.uniform(150, 245)))
    panes = int(rng.integers(1, 4))
    for k in range(panes):
        x = (k + 0.5) * length / panes - length / 2
        pane = _corners(canvas, px_per_m, 0.8 * length / panes, 0.75 * width, x=x)
        fill(canvas, pane, rng.uniform(25, 110, 3))
    return length, width


def draw_shadow(rng: Generator, canvas: Canvas, px_per_m: float, sun: Sun) -> Size:
    """Draw a shadow without a car: of a tree, a wall or a pole's head."""
    length = rng.uniform(2.0, 6.5)
    width = length * rng.uniform(0.3, 0.7)
    ring = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    radius = 1 + rng.normal(0, 0.12, 20)
    x = np.cos(ring) * length / 2 * radius
    y = np.sin(ring) * width / 2 * radius
    middle = _middle(canvas)
    outline = np.column_stack([x, y]) * px_per_m
    if rng.random() < 0.4:
        outline = _corners(canvas, px_per_m, length, width) - middle
    strength = rng.uniform(0.7, 1.15)
    shade(canvas, outline + middle, height_px=0.0, sun=sun, strength=strength)
    return length, width


def draw_bush(rng: Generator, canvas: Canvas, px_per_m: float, sun: Sun) -> Size:
    """Draw a longish crown and its shadow."""
    length = rng.uniform(2.0, 6.0)
    width = length * rng.uniform(0.4, 0.8)
    sprite = crown_sprite(rng, 64, sun)
    leaf_length_px = max(6, round(1.25 * length * px_per_m))
    leaf_width_px = max(6, round(1.25 * width * px_per_m))
    size = (leaf_length_px, leaf_width_px)
    leaf = np.asarray(cv2.resize(sprite, size, interpolation=cv2.INTER_AREA), np.float32)
    x = (canvas.shape[1] - size[0]) // 2
    y = (canvas.shape[0] - size[1]) // 2
    shade(
        canvas,
        _corners(canvas, px_per_m, 0.8 * length, 0.8 * width),
        height_px=px_per_m * rng.uniform(0.5, 3),
        sun=sun,
        strength=0.9,
    )
    target = canvas[y : y + size[1], x : x + size[0]]
    red = rng.uniform(40, 120)
    green = rng.uniform(70, 130)
    blue = rng.uniform(30, 80)
    colour = np.array([red, green, blue], np.float32)
    target[:] = target * (1 - leaf[:, :, :1]) + leaf[:, :, 1:] * colour
    return length, width


def draw_boat(rng: Generator, canvas: Canvas, px_per_m: float, sun: Sun) -> Size:
    """Draw a pointed hull with a cockpit, on water or on land."""
    if rng.random() < 0.6:
        brightness = np.float32(rng.uniform(0.6, 1.6))
        canvas[:] = 0.2 * canvas + 0.8 * np.array([40, 62, 70], np.float32) * brightness
    length = rng.uniform(3.5, 9.0)
    width = length * rng.uniform(0.28, 0.42)
    t = np.linspace(0, 1, 16)
    # The hull reaches its full width at a quarter of its length, and is elliptic towards the bow.
    bow = np.sqrt(np.clip(1 - np.clip((t - 0.45) / 0.55, 0, 1) ** 2, 0, 1))
    side = width / 2 * np.minimum(1, 0.75 + t) * bow
    along = (t - 0.5) * length
    starboard = np.column_stack([along, side])
    port = np.column_stack([along, -side])[::-1]
    hull = np.vstack([starboard, port]) * px_per_m
    middle = _middle(canvas)
    shade(canvas, hull + middle, height_px=px_per_m * 0.6, sun=sun, strength=0.8)
    fill(canvas, hull + middle, np.full(3, rng.uniform(150, 245)))
    deck = 0.7 * hull * (0.8, 1) + middle - (0.08 * length * px_per_m, 0)
    fill(canvas, deck, colour_of(rng))
    cockpit = _corners(canvas, px_per_m, 0.2 * length, 0.6 * width, x=0.08 * length)
    fill(canvas, cockpit, rng.uniform(20, 90, 3))
    return length, width


def draw_marking(rng: Generator, canvas: Canvas, px_per_m: float, sun: Sun) -> Size:
    """Draw an empty bay, a zebra crossing or a worn patch of the road."""
    del sun
    length = rng.uniform(3.5, 6.0)
    width = rng.uniform(1.8, 2.8)
    kind = rng.integers(3)
    white = np.full(3, rng.uniform(170, 245))
    if kind == 0:
        for side in (-1, 1):
            line = _corners(canvas, px_per_m, length, 0.12, y=side * width / 2)
            fill(canvas, line, white)
        fill(canvas, _corners(canvas, px_per_m, 0.12, width, x=length / 2), white)
    elif kind == 1:
        for k in range(-4, 5):
            fill(canvas, _corners(canvas, px_per_m, length, 0.5, y=k), white)
    else:
        patch = _corners(canvas, px_per_m, length, width)
        fill(canvas, patch, rng.uniform(30, 140) + rng.normal(0, 4, 3))
    return length, width


LOOKALIKES: tuple[Draw, ...] = (
    draw_box, draw_box, draw_air_conditioner, draw_row, draw_bench, draw_playground, draw_skylight,
    draw_shadow, draw_bush, draw_boat, draw_marking,
)  # fmt: skip
