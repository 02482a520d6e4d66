"""Roofs: shaded faces, courses of tiles, chimneys, windows, solar panels, machinery."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from research.scenes.sprites import Sun
from research.scenes.tile import Tile
from research.scenes.world import Rect, Rgb, Roof

_Layer = NDArray[np.float32]
# Depth of one course of tiles.
_COURSE_M = 0.36
_PARAPET_M = 0.7


def paint_roof(tile: Tile, roof: Roof, sun: Sun) -> None:
    """Draw a roof with an exact outline onto a tile."""
    outline = np.vstack([roof.corners(part) for part in roof.parts])
    corners = tile.pixels(outline)
    window = tile.window(corners.min(axis=0) - 1, corners.max(axis=0) + 1)
    if window is None:
        return
    x0, y0, x1, y1 = window
    step = tile.step
    u, v = _roof_coordinates(tile, window, roof)
    light = sun.light(roof.frame.angle)
    noise = tuple(field[y0:y1, x0:x1] for field in tile.noise)

    # Where the roofs of two parts meet, the higher one is seen.
    cover = np.zeros(u.shape, dtype=np.float32)
    height = np.full(u.shape, -1e9, dtype=np.float32)
    shade = np.ones(u.shape, dtype=np.float32)
    for part in roof.parts:
        inset, level, part_shade = _part(roof, part, u=u, v=v, light=light, step=step)
        above = level > height
        height = np.where(above, level, height)
        shade = np.where(above, part_shade, shade)
        cover = np.maximum(cover, np.clip(inset / step + 0.5, 0, 1))
    weather = 1 + 0.05 * noise[1] + 0.05 * noise[2] + 0.03 * noise[0]
    rng = np.random.default_rng(roof.seed)
    rgb = (shade * weather)[:, :, None] * np.array(roof.rgb, dtype=np.float32)
    canvas = _Canvas(rgb, u=u, v=v, step=step, sun=sun, angle=roof.frame.angle)
    if roof.style == "flat":
        for part in roof.parts:
            _flat_fittings(canvas, roof.rgb, part, rng)
    else:
        _pitched_fittings(canvas, roof.parts[0], rng)
    target = tile.rgb[y0:y1, x0:x1]
    blend = target + (canvas.rgb - target) * cover[:, :, None]
    target[:] = np.clip(blend + 0.5, 0, 255).astype(np.uint8)


def _roof_coordinates(
    tile: Tile, window: tuple[int, int, int, int], roof: Roof
) -> tuple[_Layer, _Layer]:
    """Compute the coordinates of a window's pixels in the roof's frame, metres."""
    x0, y0, x1, y1 = window
    cos = np.float32(math.cos(roof.frame.angle))
    sin = np.float32(math.sin(roof.frame.angle))
    columns = (np.arange(x0, x1, dtype=np.float32) + 0.5)[None, :]
    rows = (np.arange(y0, y1, dtype=np.float32) + 0.5)[:, None]
    px = columns * tile.step + np.float32(tile.x - roof.frame.x)
    py = rows * tile.step + np.float32(tile.y - roof.frame.y)
    return px * cos + py * sin, py * cos - px * sin


def _part(
    roof: Roof, part: Rect, *, u: _Layer, v: _Layer, light: tuple[float, float, float], step: float
) -> tuple[_Layer, _Layer, _Layer]:
    """Compute distance inside the outline, height and shading of one rectangle's roof."""
    left, top, right, bottom = part
    distances = [
        u - np.float32(left),
        np.float32(right) - u,
        v - np.float32(top),
        np.float32(bottom) - v,
    ]
    from_ends = np.minimum(distances[0], distances[1])
    from_sides = np.minimum(distances[2], distances[3])
    inset = np.minimum(from_ends, from_sides).astype(np.float32)
    if roof.style == "flat":
        shade = _flat_shade(inset, distances, light=light, step=step)
        level = np.where(inset >= -step, 1.0, -1e6)
        return inset, level.astype(np.float32), shade
    if roof.style == "hip":
        sides = [0, 1, 2, 3]
    elif right - left >= bottom - top:
        sides = [2, 3]
    else:
        sides = [0, 1]
    nearest, shade = _pitched_shade(
        [distances[side] for side in sides],
        [_NORMALS[side] for side in sides],
        pitch=roof.pitch,
        light=light,
        step=step,
    )
    level = np.where(inset >= -step, nearest * roof.pitch, -1e6)
    return inset, level.astype(np.float32), shade


# Outward normals of the sides: left, right, top, bottom.
_NORMALS = ((-1, 0), (1, 0), (0, -1), (0, 1))


def _flat_shade(
    inset: _Layer, distances: list[_Layer], *, light: tuple[float, float, float], step: float
) -> _Layer:
    """Shade a flat roof: a bright parapet, whose shadow falls inside on the sides to the sun."""
    shade = np.ones_like(inset)
    reach = _PARAPET_M / math.tan(max(math.asin(light[2]), 0.2))
    horizontal = math.hypot(light[0], light[1])
    for (nx, ny), distance in zip(_NORMALS, distances, strict=True):
        facing = (nx * light[0] + ny * light[1]) / horizontal
        if facing > 0:
            depth = 0.3 + reach * facing
            shadow = np.clip((depth - distance) / max(step, 0.05) + 0.5, 0, 1)
            shade *= 1 - 0.5 * shadow
    rim = np.clip((0.3 - inset) / step + 0.5, 0, 1)
    shade += (1.12 - shade) * rim
    return shade.astype(np.float32)


def _pitched_shade(
    distances: list[_Layer],
    normals: list[tuple[int, int]],
    *,
    pitch: float,
    light: tuple[float, float, float],
    step: float,
) -> tuple[_Layer, _Layer]:
    """Shade the faces of a pitched roof, one for each side, with courses of tiles and ridges.

    Returns:
        Distance to the side of each pixel's face, and the shade.
    """
    shape = distances[0].shape
    nearest = np.full(shape, 1e6, dtype=np.float32)
    second = np.full(shape, 1e6, dtype=np.float32)
    lambert = np.ones(shape, dtype=np.float32)
    course = np.zeros(shape, dtype=np.float32)
    for distance, (nx, ny) in zip(distances, normals, strict=True):
        # Lambert's law relative to level ground, which light[2] lights, with 0.42 of sky.
        facing = nx * light[0] + ny * light[1]
        face = (pitch * facing + light[2]) / math.hypot(pitch, 1)
        value = 0.42 + 0.58 * max(face, 0.0) / light[2]
        closer = distance < nearest
        second = np.where(closer, nearest, np.minimum(second, distance))
        nearest = np.where(closer, distance, nearest)
        lambert = np.where(closer, np.float32(value), lambert)
        course = np.where(closer, distance, course)
    # Courses fade out where the pixels are too coarse to show them.
    fade = float(np.clip(0.20 / step - 0.9, 0, 1))
    if fade > 0:
        phase = course / np.float32(_COURSE_M)
        within_course = phase - np.floor(phase)
        lambert = lambert * (1 + fade * 0.10 * (0.5 - within_course))
    # A ridge is where two faces are equally near.
    from_ridge = second - nearest
    ridge = np.clip((0.16 - from_ridge) / max(step, 0.08) + 0.5, 0, 1)
    shade = lambert * (1 + 0.14 * ridge)
    return nearest, shade.astype(np.float32)


@dataclass(eq=False)
class _Canvas:
    """Picture of a roof, on which fittings are drawn in the roof's frame.

    Attributes:
        rgb: ``[h, w, 3]``, changed in place.
        u: ``[h, w]`` coordinate along the frame's x axis, metres.
        v: ``[h, w]`` coordinate along the frame's y axis, metres.
        step: metres per pixel.
        sun: the sun, for shadows.
        angle: angle of the frame in the scene, radians.
    """

    rgb: _Layer
    u: _Layer
    v: _Layer
    step: float
    sun: Sun
    angle: float

    def rectangle(self, box: Rect, rgb: Rgb, opacity: float = 1.0) -> None:
        """Blend in an axis-aligned rectangle, given by its centre and size."""
        x, y, w, h = box
        cover = self._cover(x, y, w, h)[:, :, None] * opacity * self._visible(w, h)
        colour = np.array(rgb, dtype=np.float32)
        self.rgb += (colour - self.rgb) * cover

    def block(self, box: Rect, height: float, rgb: Rgb) -> None:
        """Draw a block, given by its centre and size, with its shadow."""
        x, y, w, h = box
        dx, dy = self.sun.shadow(height)
        cos = math.cos(self.angle)
        sin = math.sin(self.angle)
        shift_x = dx * cos + dy * sin
        shift_y = dy * cos - dx * sin
        # The shadow is the union of the outline at four places between the block and its end.
        shadow = np.zeros(self.u.shape, dtype=np.float32)
        for share in (0.25, 0.5, 0.75, 1.0):
            block_x = x + share * shift_x
            block_y = y + share * shift_y
            shadow = np.maximum(shadow, self._cover(block_x, block_y, w, h))
        self.rgb *= 1 - 0.52 * shadow[:, :, None] * self._visible(w, h)
        self.rectangle(box, rgb)
        top = cast("Rgb", tuple(int(0.88 * channel) for channel in rgb))
        self.rectangle((x, y, 0.6 * w, 0.6 * h), top)

    def _cover(self, x: float, y: float, w: float, h: float) -> _Layer:
        """Compute the cover of each pixel by a rectangle, a ramp one pixel wide."""
        from_ends = w / 2 - np.abs(self.u - np.float32(x))
        from_sides = h / 2 - np.abs(self.v - np.float32(y))
        inset = np.minimum(from_ends, from_sides)
        return np.asarray(np.clip(inset / self.step + 0.5, 0, 1))

    def _visible(self, w: float, h: float) -> float:
        """Compute the contrast of a rectangle that can be smaller than a pixel."""
        return min(1.0, w / self.step, h / self.step)


def _pitched_fittings(canvas: _Canvas, part: Rect, rng: Generator) -> None:
    """Add chimneys, roof windows and solar panels to a pitched roof."""
    x0, y0, x1, y1 = part
    w = x1 - x0
    h = y1 - y0
    centre_x = (x0 + x1) / 2
    centre_y = (y0 + y1) / 2
    along_x = w >= h
    side = float(rng.choice([-1, 1]))

    def position(along: float, across: float) -> tuple[float, float]:
        """Convert shares of the half extents along and across the ridge to a position."""
        if along_x:
            return centre_x + along * w / 2, centre_y + across * h / 2
        return centre_x + across * w / 2, centre_y + along * h / 2

    # Chimneys.
    for _ in range(rng.integers(0, 3)):
        x, y = position(rng.uniform(-0.6, 0.6), rng.uniform(-0.35, 0.35))
        canvas.block((x, y, 0.7, 0.6), 1.1, (150, 130, 118))
    # Roof windows: a frame, and glass that reflects the sky or does not.
    if rng.random() < 0.35:
        for _ in range(rng.integers(1, 4)):
            x, y = position(rng.uniform(-0.6, 0.6), side * rng.uniform(0.4, 0.6))
            size = (0.85, 1.2) if along_x else (1.2, 0.85)
            frame = (x, y, size[0] + 0.2, size[1] + 0.2)
            canvas.rectangle(frame, (90, 84, 80))
            glass = (120, 140, 158) if rng.random() < 0.5 else (48, 56, 64)
            canvas.rectangle((x, y, *size), glass)
    # Solar panels, left out where they would not fit on the roof.
    if rng.random() < 0.3:
        columns = int(rng.integers(2, 6))
        rows = int(rng.integers(1, 3))
        panel = (1.0, 1.65 * 0.9)
        size = panel if along_x else panel[::-1]
        x, y = position(rng.uniform(-0.25, 0.25), side * 0.5)
        for column in range(columns):
            for row in range(rows):
                du = (column - columns / 2 + 0.5) * (panel[0] + 0.04)
                dv = (row - rows / 2 + 0.5) * (panel[1] + 0.04)
                if not along_x:
                    du, dv = dv, du
                panel_x = x + du
                panel_y = y + dv
                fits_x = abs(panel_x - centre_x) < w / 2 - 0.8
                fits_y = abs(panel_y - centre_y) < h / 2 - 0.8
                if fits_x and fits_y:
                    canvas.rectangle((panel_x, panel_y, *size), (112, 118, 128))
                    cells = (panel_x, panel_y, size[0] - 0.12, size[1] - 0.12)
                    canvas.rectangle(cells, (34, 42, 66))


def _random_box(part: Rect, rng: Generator, size: tuple[float, float]) -> Rect:
    """Draw a position on a flat roof, away from its edge: centre and size."""
    x0, y0, x1, y1 = part
    margin = 1.6
    sx = min(size[0], x1 - x0 - 2 * margin - 0.2)
    sy = min(size[1], y1 - y0 - 2 * margin - 0.2)
    x = rng.uniform(x0 + margin + sx / 2, x1 - margin - sx / 2)
    y = rng.uniform(y0 + margin + sy / 2, y1 - margin - sy / 2)
    return float(x), float(y), sx, sy


def _flat_fittings(canvas: _Canvas, roof_rgb: Rgb, part: Rect, rng: Generator) -> None:
    """Add sheets, seams, roof lights, machinery and solar panels to one part of a flat roof."""
    x0, y0, x1, y1 = part
    w = x1 - x0
    h = y1 - y0
    area = w * h
    if min(w, h) < 5:
        return
    # Newer or older sheets.
    for _ in range(rng.poisson(min(area / 500, 4))):
        size = (rng.uniform(3, 10), rng.uniform(3, 10))
        box = _random_box(part, rng, size)
        sheet = cast("Rgb", tuple(int(channel * rng.uniform(0.88, 1.08)) for channel in roof_rgb))
        canvas.rectangle(box, sheet, 0.6)
    _draw_seams(canvas, x0)
    # Rows of roof lights, as large as cars.
    if area > 700 and rng.random() < 0.6:
        count_x = max(int(w // 11), 1)
        count_y = max(int(h // 9), 1)
        size = (4.2, 1.7) if rng.random() < 0.5 else (1.6, 1.6)
        for i in range(count_x):
            for j in range(count_y):
                x = x0 + (i + 0.5) * w / count_x
                y = y0 + (j + 0.5) * h / count_y
                canvas.block((x, y, *size), 0.35, (226, 230, 232))
    # Machines for heating and air.
    for _ in range(rng.poisson(min(1 + area / 350, 8))):
        size = (rng.uniform(0.9, 3.2), rng.uniform(0.9, 2.2))
        grey = int(rng.uniform(130, 215))
        box = _random_box(part, rng, size)
        canvas.block(box, rng.uniform(0.5, 1.4), (grey, grey, grey))
    # Vents.
    for _ in range(rng.poisson(min(area / 150, 10))):
        vent = _random_box(part, rng, (0.5, 0.5))
        canvas.block(vent, 0.5, (150, 150, 150))
    # A staircase or lift.
    if area > 120 and rng.random() < 0.4:
        size = (rng.uniform(3, 5), rng.uniform(2.5, 4))
        box = _random_box(part, rng, size)
        canvas.block(box, 2.6, (188, 184, 178))
    # Rows of solar panels.
    if rng.random() < 0.22:
        size = (rng.uniform(4, 0.5 * w + 4), rng.uniform(3, 0.4 * h + 3))
        x, y, width, depth = _random_box(part, rng, size)
        rows = max(int(depth // 1.9), 1)
        for row in range(rows):
            row_y = y - depth / 2 + (row + 0.5) * depth / rows
            canvas.rectangle((x, row_y, width, 1.1), (36, 44, 68))
    pipe = _random_box(part, rng, (0.35, 0.6 * h))
    if rng.random() < 0.3:
        canvas.block(pipe, 0.4, (176, 178, 180))


def _draw_seams(canvas: _Canvas, x0: float) -> None:
    """Darken the seams between sheets, which fade out where the pixels are too coarse."""
    seam = 1.2
    fade = float(np.clip(0.12 / canvas.step - 0.5, 0, 1))
    if fade > 0:
        phase = (canvas.u - np.float32(x0)) / np.float32(seam)
        from_seam = np.abs(phase - np.round(phase)) * seam
        lines = np.clip(1 - from_seam / max(canvas.step, 0.05), 0, 1)
        canvas.rgb *= 1 - 0.05 * fade * lines[:, :, None]
