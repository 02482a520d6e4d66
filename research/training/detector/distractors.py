"""Distractors drawn over training crops: striped and gridded objects of every size.

Zebra crossings, rows of vineyard posts with their shadows, tombs, solar panels, crates, pontoons:
all are many like shapes in a regular pattern on ground that shows between them. They are drawn
plain, each like its neighbour; a car has windows and neighbours of other colours.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Picture: TypeAlias = NDArray[np.uint8]
"""RGB picture ``[h, w, 3]``."""

Mask: TypeAlias = NDArray[np.bool_]
"""Pixels ``[h, w]``."""

Colour: TypeAlias = NDArray[np.float32]
"""Colour ``[3]`` in 0..255."""

# Fractional bits of OpenCV's coordinates.
_SHIFT = 4
# Colour [h, w, 3] in 0..255, and opacity [h, w] in 0..1.
_Layer = tuple[NDArray[np.float32], NDArray[np.float32]]
# Draws one kind of distractor.
_Draw = Callable[[Generator, Picture], _Layer]


def draw_distractors(
    rng: Generator, image: Picture, kind: str | None = None
) -> tuple[Picture, Mask]:
    """Lay a patch of one kind over an image.

    Args:
        rng: random numbers.
        image: ``[h, w, 3]``.
        kind: a key of ``KINDS``; any of them for None.

    Returns:
        The new image, and ``[h, w]`` where the patch hides what was there.
    """
    height, width = image.shape[:2]
    kind = kind or list(KINDS)[rng.integers(len(KINDS))]
    colour, opacity = KINDS[kind](rng, image)
    turn = rng.uniform(0, 180)
    matrix = cv2.getRotationMatrix2D((width / 2, height / 2), turn, 1.0)
    size = (width, height)
    turned = cv2.warpAffine(colour, matrix, size, borderMode=cv2.BORDER_REFLECT)
    colour = np.asarray(turned, np.float32)
    opacity = np.asarray(cv2.warpAffine(opacity, matrix, size), np.float32)
    log_shares = rng.uniform(np.log(0.25), np.log(0.9), 2)
    sides = np.exp(log_shares) * (width, height)
    middle = rng.uniform(0.15, 0.85, 2) * (width, height)
    corners = cv2.boxPoints((middle.tolist(), sides.tolist(), turn))
    patch = np.zeros((height, width), np.uint8)
    cv2.fillPoly(patch, [np.round(corners).astype(np.int32)], 1)
    opacity = opacity * patch
    mixed = image * (1 - opacity[:, :, None]) + colour * opacity[:, :, None]
    is_opaque = (opacity > 0.3).astype(np.uint8)
    grown = cv2.dilate(is_opaque, np.ones((5, 5), np.uint8))
    picture = np.clip(mixed + 0.5, 0, 255).astype(np.uint8)
    return picture, np.asarray(grown, bool)


def _paint(rng: Generator, low: int, high: int, chroma: float = 12.0) -> Colour:
    rgb = rng.uniform(low, high) + rng.normal(0, chroma, 3)
    return np.clip(rgb, 0, 255).astype(np.float32)


def _ground(rng: Generator, image: Picture) -> _Layer:
    """Even ground of the image's own tone, or none."""
    height, width = image.shape[:2]
    tone = image.reshape(-1, 3).mean(axis=0) * rng.uniform(0.6, 1.3)
    grain = rng.normal(0, rng.uniform(2, 9), (height, width, 1))
    colour = np.clip(tone + grain, 0, 255).astype(np.float32)
    opacity = np.full((height, width), 1.0 if rng.random() < 0.5 else 0.0, np.float32)
    return colour, opacity


def _rectangles(
    rng: Generator,
    layer: _Layer,
    size: tuple[float, float],
    pitch: tuple[float, float],
    paints: list[Colour],
    shadow: float,
) -> _Layer:
    """Draw a regular array.

    ``size`` and ``pitch`` are in pixels along and across; ``shadow`` is a share of a side.
    """
    colour, opacity = layer
    height, width = opacity.shape
    sun = rng.uniform(0, 2 * np.pi)
    offset = shadow * min(size) * np.array([np.cos(sun), np.sin(sun)])
    jitter = 0.03 * min(pitch)
    columns = np.arange(0, width, pitch[0])
    rows = np.arange(0, height, pitch[1])
    centres = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    centres = centres + rng.normal(0, jitter, centres.shape)
    square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    corner = square * size

    def fill(moved: NDArray[np.float64], paint: Colour, strength: float) -> None:
        scaled = np.round((corner + moved) * 2**_SHIFT)
        polygon = scaled.astype(np.int32)
        cv2.fillConvexPoly(colour, polygon, paint.tolist(), cv2.LINE_AA, _SHIFT)
        cv2.fillConvexPoly(opacity, polygon, strength, cv2.LINE_8, _SHIFT)

    missing = rng.uniform(0, 0.3)
    for centre in centres:
        if rng.random() < missing:
            continue
        if shadow:
            fill(centre + offset, _SHADOW, 0.9)
        fill(centre, paints[rng.integers(len(paints))], 1.0)
    return colour, opacity


_SHADOW = np.array([25.0, 25.0, 30.0], np.float32)


def _zebra(rng: Generator, image: Picture) -> _Layer:
    thick = float(np.exp(rng.uniform(np.log(2.5), np.log(18))))
    long = thick * rng.uniform(3, 9)
    pitch = (long * rng.uniform(1.5, 5), thick * rng.uniform(1.7, 2.4))
    return _rectangles(
        rng,
        _ground(rng, image),
        size=(long, thick),
        pitch=pitch,
        paints=[_paint(rng, 180, 255, 6)],
        shadow=0.0,
    )


def _posts(rng: Generator, image: Picture) -> _Layer:
    thick = float(np.exp(rng.uniform(np.log(1.5), np.log(9))))
    size = (thick * rng.uniform(1.0, 2.6), thick)
    pitch = (thick * rng.uniform(2.5, 8), thick * rng.uniform(3, 10))
    return _rectangles(
        rng,
        _ground(rng, image),
        size=size,
        pitch=pitch,
        paints=[_paint(rng, 130, 255)],
        shadow=rng.uniform(0, 1.5),
    )


def _slabs(rng: Generator, image: Picture) -> _Layer:
    """Draw tombs, crates, containers or pontoons: plain, of a few paints, with shadows."""
    thick = float(np.exp(rng.uniform(np.log(3), np.log(26))))
    size = (thick * rng.uniform(1.2, 4.5), thick)
    pitch = (size[0] * rng.uniform(1.15, 2.0), thick * rng.uniform(1.25, 2.6))
    paints = [_paint(rng, 50, 235, 22) for _ in range(rng.integers(1, 4))]
    return _rectangles(
        rng,
        _ground(rng, image),
        size=size,
        pitch=pitch,
        paints=paints,
        shadow=rng.uniform(0, 0.5),
    )


def _panels(rng: Generator, image: Picture) -> _Layer:
    """Solar panels and roof windows: dark, glossy, close together."""
    thick = float(np.exp(rng.uniform(np.log(3), np.log(26))))
    size = (thick * rng.uniform(1.3, 2.2), thick)
    pitch = (size[0] * rng.uniform(1.04, 1.4), thick * rng.uniform(1.05, 2.2))
    red = rng.uniform(15, 60)
    green = rng.uniform(20, 70)
    blue = rng.uniform(40, 110)
    paint = np.array([red, green, blue], np.float32)
    return _rectangles(
        rng,
        _ground(rng, image),
        size=size,
        pitch=pitch,
        paints=[paint, paint * np.float32(1.15)],
        shadow=0.0,
    )


def _crowns(rng: Generator, image: Picture) -> _Layer:
    """Plantations: round crowns in rows, each with its shadow."""
    colour, opacity = _ground(rng, image)
    height, width = opacity.shape
    radius = float(np.exp(rng.uniform(np.log(2.5), np.log(14))))
    pitch = radius * rng.uniform(2.1, 4.5, 2)
    red = rng.uniform(30, 90)
    green = rng.uniform(60, 130)
    blue = rng.uniform(25, 80)
    paint = np.array([red, green, blue])
    sun = rng.uniform(0, 2 * np.pi)
    for y in np.arange(0, height, pitch[1]):
        for x in np.arange(0, width, pitch[0]):
            r = radius * rng.uniform(0.7, 1.15)
            along_x = r * np.cos(sun)
            along_y = r * np.sin(sun)
            for dx, dy, tone, strength in (
                (0.7 * along_x, 0.7 * along_y, _SHADOW, 0.8),
                (0.0, 0.0, paint, 1.0),
                (-0.3 * along_x, -0.3 * along_y, paint * 1.35, 1.0),
            ):
                small = 0.55 * r if tone is not paint and strength == 1.0 else r
                centre = (round((x + dx) * 2**_SHIFT), round((y + dy) * 2**_SHIFT))
                cv2.circle(
                    colour,
                    centre,
                    round(small * 2**_SHIFT),
                    np.asarray(tone).tolist(),
                    -1,
                    cv2.LINE_AA,
                    _SHIFT,
                )
                cv2.circle(
                    opacity, centre, round(small * 2**_SHIFT), strength, -1, cv2.LINE_8, _SHIFT
                )
    return colour, opacity


KINDS: dict[str, _Draw] = {
    "zebra": _zebra,
    "posts": _posts,
    "slabs": _slabs,
    "panels": _panels,
    "crowns": _crowns,
}
