"""Roofs: shaded faces, courses of tiles, chimneys, windows, solar panels, machinery."""

from __future__ import annotations

import math
from typing import cast

import numpy as np
from numpy.typing import NDArray

from research.scenes.sprites import Sun
from research.scenes.tile import Tile
from research.scenes.world import Rect, Rgb, Roof

_F = NDArray[np.float32]
_COURSE_M = 0.36  # one course of tiles
_PARAPET_M = 0.7


def paint_roof(tile: Tile, roof: Roof, sun: Sun) -> None:
    """Draw a roof with an exact outline onto a tile."""
    corners = tile.pixels(np.vstack([roof.corners(part) for part in roof.parts]))
    window = tile.window(corners.min(axis=0) - 1, corners.max(axis=0) + 1)
    if window is None:
        return
    x0, y0, x1, y1 = window
    step = tile.step
    cos = math.cos(roof.frame.angle)
    sin = math.sin(roof.frame.angle)
    px = (np.arange(x0, x1, dtype=np.float32) + 0.5)[None, :] * step + np.float32(
        tile.x - roof.frame.x
    )
    py = (np.arange(y0, y1, dtype=np.float32) + 0.5)[:, None] * step + np.float32(
        tile.y - roof.frame.y
    )
    u = px * np.float32(cos) + py * np.float32(sin)
    v = py * np.float32(cos) - px * np.float32(sin)
    light = sun.light(roof.frame.angle)
    noise = tuple(field[y0:y1, x0:x1] for field in tile.noise)
    cover = np.zeros(u.shape, dtype=np.float32)
    height = np.full(u.shape, -1e9, dtype=np.float32)
    shade = np.ones(u.shape, dtype=np.float32)
    for part in roof.parts:
        inset, level, part_shade = _part(roof, part, u, v, light, step)
        above = level > height
        height = np.where(above, level, height)
        shade = np.where(above, part_shade, shade)
        cover = np.maximum(cover, np.clip(inset / step + 0.5, 0, 1))
    weather = 1 + 0.05 * noise[1] + 0.05 * noise[2] + 0.03 * noise[0]
    rng = np.random.default_rng(roof.seed)
    picture = (shade * weather)[:, :, None] * np.array(roof.rgb, dtype=np.float32)
    if roof.style == "flat":
        for part in roof.parts:
            _flat_fittings(picture, roof, part=part, u=u, v=v, sun=sun, rng=rng, step=step)
    else:
        _pitched_fittings(picture, roof, u=u, v=v, sun=sun, rng=rng, step=step)
    target = tile.rgb[y0:y1, x0:x1]
    blend = target + (picture - target) * cover[:, :, None]
    target[:] = np.clip(blend + 0.5, 0, 255).astype(np.uint8)


def _part(
    roof: Roof, part: Rect, u: _F, v: _F, light: tuple[float, float, float], step: float
) -> tuple[_F, _F, _F]:
    """Compute distance inside the outline, height and shading of one rectangle's roof."""
    left, top, right, bottom = part
    distances = [
        u - np.float32(left),
        np.float32(right) - u,
        v - np.float32(top),
        np.float32(bottom) - v,
    ]
    inset = np.minimum(
        np.minimum(distances[0], distances[1]), np.minimum(distances[2], distances[3])
    ).astype(np.float32)
    if roof.style == "flat":
        shade = np.ones_like(inset)
        # The parapet is bright; on the sides towards the sun its shadow falls inside.
        reach = _PARAPET_M / math.tan(max(math.asin(light[2]), 0.2))
        horizontal = math.hypot(light[0], light[1])
        sunward = ((-1, 0, 0), (1, 0, 1), (0, -1, 2), (0, 1, 3))
        for nx, ny, index in sunward:
            facing = (nx * light[0] + ny * light[1]) / horizontal
            if facing > 0:
                depth = 0.3 + reach * facing
                shade *= 1 - 0.5 * np.clip((depth - distances[index]) / max(step, 0.05) + 0.5, 0, 1)
        rim = np.clip((0.3 - inset) / step + 0.5, 0, 1)
        shade += (1.12 - shade) * rim
        return (
            inset,
            np.where(inset >= -step, 1.0, -1e6).astype(np.float32),
            shade.astype(np.float32),
        )
    along_x = right - left >= bottom - top
    normals = [(-1, 0), (1, 0), (0, -1), (0, 1)]
    sides = [0, 1, 2, 3] if roof.style == "hip" else [2, 3] if along_x else [0, 1]
    nearest = np.full(u.shape, 1e6, dtype=np.float32)
    second = np.full(u.shape, 1e6, dtype=np.float32)
    lambert = np.ones(u.shape, dtype=np.float32)
    course = np.zeros(u.shape, dtype=np.float32)
    for side in sides:
        distance = distances[side]
        nx, ny = normals[side]
        face = (roof.pitch * (nx * light[0] + ny * light[1]) + light[2]) / math.hypot(roof.pitch, 1)
        value = 0.42 + 0.58 * max(face, 0.0) / light[2]
        closer = distance < nearest
        second = np.where(closer, nearest, np.minimum(second, distance))
        nearest = np.where(closer, distance, nearest)
        lambert = np.where(closer, np.float32(value), lambert)
        course = np.where(closer, distance, course)
    fade = float(np.clip(0.20 / step - 0.9, 0, 1))
    if fade > 0:
        phase = course / np.float32(_COURSE_M)
        lambert = lambert * (1 + fade * 0.10 * (0.5 - (phase - np.floor(phase))))
    ridge = np.clip((0.16 - (second - nearest)) / max(step, 0.08) + 0.5, 0, 1)
    shade = lambert * (1 + 0.14 * ridge)
    level = np.where(inset >= -step, nearest * roof.pitch, -1e6)
    return inset, level.astype(np.float32), shade.astype(np.float32)


def _rectangle(
    picture: _F, u: _F, v: _F, box: Rect, rgb: Rgb, step: float, opacity: float = 1.0
) -> None:
    """Blend in an axis-aligned rectangle of the roof's frame, given by its centre and size."""
    x, y, w, h = box
    inset = np.minimum(w / 2 - np.abs(u - np.float32(x)), h / 2 - np.abs(v - np.float32(y)))
    cover = np.clip(inset / step + 0.5, 0, 1)[:, :, None] * opacity * min(1.0, w / step, h / step)
    picture += (np.array(rgb, dtype=np.float32) - picture) * cover


def _raised(
    picture: _F, roof: Roof, u: _F, v: _F, sun: Sun, box: Rect, height: float, rgb: Rgb, step: float
) -> None:
    """Draw a block on the roof, with its shadow."""
    x, y, w, h = box
    dx, dy = sun.shadow(height)
    cos = math.cos(roof.frame.angle)
    sin = math.sin(roof.frame.angle)
    offset = (dx * cos + dy * sin, dy * cos - dx * sin)
    shadow = np.zeros(u.shape, dtype=np.float32)
    for share in (0.25, 0.5, 0.75, 1.0):
        cx = x + share * offset[0]
        cy = y + share * offset[1]
        inset = np.minimum(w / 2 - np.abs(u - np.float32(cx)), h / 2 - np.abs(v - np.float32(cy)))
        shadow = np.maximum(shadow, np.clip(inset / step + 0.5, 0, 1))
    picture *= 1 - 0.52 * shadow[:, :, None] * min(1.0, w / step, h / step)
    _rectangle(picture, u, v, box, rgb, step)
    _rectangle(
        picture,
        u,
        v,
        (x, y, 0.6 * w, 0.6 * h),
        cast("Rgb", tuple(int(0.88 * c) for c in rgb)),
        step,
    )


def _pitched_fittings(
    picture: _F, roof: Roof, u: _F, v: _F, sun: Sun, rng: np.random.Generator, step: float
) -> None:
    x0, y0, x1, y1 = roof.parts[0]
    w = x1 - x0
    h = y1 - y0
    along_x = w >= h
    side = float(rng.choice([-1, 1]))

    def place(along: float, across: float) -> tuple[float, float]:
        """Convert shares of the half extents along and across the ridge to a position."""
        cx = (x0 + x1) / 2
        cy = (y0 + y1) / 2
        return (
            (cx + along * w / 2, cy + across * h / 2)
            if along_x
            else (cx + across * w / 2, cy + along * h / 2)
        )

    for _ in range(int(rng.integers(0, 3))):
        x, y = place(rng.uniform(-0.6, 0.6), rng.uniform(-0.35, 0.35))
        _raised(picture, roof, u, v, sun, (x, y, 0.7, 0.6), 1.1, (150, 130, 118), step)
    if rng.random() < 0.35:
        for _ in range(int(rng.integers(1, 4))):
            x, y = place(rng.uniform(-0.6, 0.6), side * rng.uniform(0.4, 0.6))
            size = (0.85, 1.2) if along_x else (1.2, 0.85)
            _rectangle(picture, u, v, (x, y, size[0] + 0.2, size[1] + 0.2), (90, 84, 80), step)
            _rectangle(
                picture,
                u,
                v,
                (x, y, *size),
                (120, 140, 158) if rng.random() < 0.5 else (48, 56, 64),
                step,
            )
    if rng.random() < 0.3:
        columns = int(rng.integers(2, 6))
        rows = int(rng.integers(1, 3))
        panel = (1.0, 1.65 * 0.9)
        along = rng.uniform(-0.25, 0.25)
        for column in range(columns):
            for row in range(rows):
                x, y = place(along, side * 0.5)
                du = (column - columns / 2 + 0.5) * (panel[0] + 0.04)
                dv = (row - rows / 2 + 0.5) * (panel[1] + 0.04)
                if not along_x:
                    du, dv = dv, du
                size = panel if along_x else panel[::-1]
                if (
                    abs(x + du - (x0 + x1) / 2) < w / 2 - 0.8
                    and abs(y + dv - (y0 + y1) / 2) < h / 2 - 0.8
                ):
                    _rectangle(picture, u, v, (x + du, y + dv, *size), (112, 118, 128), step)
                    _rectangle(
                        picture,
                        u,
                        v,
                        (x + du, y + dv, size[0] - 0.12, size[1] - 0.12),
                        (34, 42, 66),
                        step,
                    )


def _spot(part: Rect, rng: np.random.Generator, size: tuple[float, float]) -> Rect:
    """Draw a position on a flat roof, away from its edge: centre and size."""
    x0, y0, x1, y1 = part
    margin = 1.6
    sx = min(size[0], x1 - x0 - 2 * margin - 0.2)
    sy = min(size[1], y1 - y0 - 2 * margin - 0.2)
    x = rng.uniform(x0 + margin + sx / 2, x1 - margin - sx / 2)
    y = rng.uniform(y0 + margin + sy / 2, y1 - margin - sy / 2)
    return float(x), float(y), sx, sy


def _flat_fittings(
    picture: _F,
    roof: Roof,
    part: Rect,
    u: _F,
    v: _F,
    sun: Sun,
    rng: np.random.Generator,
    step: float,
) -> None:
    x0, y0, x1, y1 = part
    w = x1 - x0
    h = y1 - y0
    area = w * h
    if min(w, h) < 5:
        return
    for _ in range(int(rng.poisson(min(area / 500, 4)))):  # newer or older sheets
        box = _spot(part, rng, (rng.uniform(3, 10), rng.uniform(3, 10)))
        _rectangle(
            picture,
            u,
            v,
            box,
            cast("Rgb", tuple(int(c * rng.uniform(0.88, 1.08)) for c in roof.rgb)),
            step,
            0.6,
        )
    seam = 1.2
    fade = float(np.clip(0.12 / step - 0.5, 0, 1))
    if fade > 0:
        phase = (u - np.float32(x0)) / np.float32(seam)
        lines = np.clip(1 - np.abs(phase - np.round(phase)) * seam / max(step, 0.05), 0, 1)
        picture *= 1 - 0.05 * fade * lines[:, :, None]
    if area > 700 and rng.random() < 0.6:  # rows of roof lights, as large as cars
        count_x = max(int(w // 11), 1)
        count_y = max(int(h // 9), 1)
        size = (4.2, 1.7) if rng.random() < 0.5 else (1.6, 1.6)
        for i in range(count_x):
            for j in range(count_y):
                box = (x0 + (i + 0.5) * w / count_x, y0 + (j + 0.5) * h / count_y, *size)
                _raised(picture, roof, u, v, sun, box, 0.35, (226, 230, 232), step)
    for _ in range(int(rng.poisson(min(1 + area / 350, 8)))):
        size = (rng.uniform(0.9, 3.2), rng.uniform(0.9, 2.2))
        grey = int(rng.uniform(130, 215))
        _raised(
            picture,
            roof,
            u,
            v,
            sun,
            _spot(part, rng, size),
            rng.uniform(0.5, 1.4),
            (grey, grey, grey),
            step,
        )
    for _ in range(int(rng.poisson(min(area / 150, 10)))):
        _raised(picture, roof, u, v, sun, _spot(part, rng, (0.5, 0.5)), 0.5, (150, 150, 150), step)
    if area > 120 and rng.random() < 0.4:  # staircase or lift
        _raised(
            picture,
            roof,
            u,
            v,
            sun,
            _spot(part, rng, (rng.uniform(3, 5), rng.uniform(2.5, 4))),
            2.6,
            (188, 184, 178),
            step,
        )
    if rng.random() < 0.22:
        box = _spot(part, rng, (rng.uniform(4, 0.5 * w + 4), rng.uniform(3, 0.4 * h + 3)))
        rows = max(int(box[3] // 1.9), 1)
        for row in range(rows):
            y = box[1] - box[3] / 2 + (row + 0.5) * box[3] / rows
            _rectangle(picture, u, v, (box[0], y, box[2], 1.1), (36, 44, 68), step)
    pipe = _spot(part, rng, (0.35, 0.6 * h))
    if rng.random() < 0.3:
        _raised(picture, roof, u, v, sun, pipe, 0.4, (176, 178, 180), step)
