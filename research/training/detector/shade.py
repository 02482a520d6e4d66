"""Augmentations that hide cars: cast shadows, bare branches, paint as dark as asphalt.

Of fifty missed cars of Estonian towns, two in three were dark, in a building's shadow or below
branches.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import cv2
import numpy as np

from vehanchor.detection.boxes import box_corners

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    Picture: TypeAlias = NDArray[np.uint8]
    """RGB picture ``[h, w, 3]``."""

    Boxes: TypeAlias = NDArray[np.float64]
    """Boxes ``[n, 5]``: x, y, length, width, angle."""

    Point: TypeAlias = NDArray[np.float64]
    """Point x, y ``[2]`` in pixels."""

    Layer: TypeAlias = NDArray[np.float32]
    """Coverage or brightness ``[h, w]`` or ``[h, w, 3]``."""

    Points: TypeAlias = NDArray[np.float64]
    """Points x, y ``[n, 2]`` in pixels."""

# Length of a car in a crop without cars.
_CAR_PX = 24.0
# Shares of crops with dark cars, with branches and with a shadow.
_DARK_SHARE = 0.15
_BRANCH_SHARE = 0.12
_SHADOW_SHARE = 0.2
# Share of dark cars in a crop with dark cars.
_DARK_CARS = 0.4
# Share of shadows and crowns that lie beside a car.
_AT_CAR = 0.6
# Fractional bits of OpenCV's coordinates.
_SHIFT = 4


def shaded(rng: Generator, image: Picture, boxes: Boxes) -> Picture:
    """Apply none, one or several of the three, each with its probability.

    Args:
        rng: random numbers.
        image: ``[h, w, 3]``.
        boxes: ``[n, 5]`` of the cars in it.
    """
    car_px = float(np.median(boxes[:, 2])) if len(boxes) else _CAR_PX
    dark, branches, shadow = rng.random(3) < (_DARK_SHARE, _BRANCH_SHARE, _SHADOW_SHARE)
    if dark:
        image = darken_cars(rng, image, boxes)
    if branches:
        for _ in range(rng.integers(1, 6)):
            foot = _position(rng, image, boxes)
            image = draw_crown(rng, image, foot=foot, car_px=car_px)
    if shadow:
        middle = _position(rng, image, boxes)
        image = cast_shadow(rng, image, middle=middle, car_px=car_px)
    return image


def _position(rng: Generator, image: Picture, boxes: Boxes) -> Point:
    """Draw a position beside a car or anywhere."""
    if len(boxes) and rng.random() < _AT_CAR:
        x, y, length, _, _ = boxes[rng.integers(len(boxes))]
        return np.array([x, y]) + rng.normal(0, 0.6 * length, 2)
    return rng.uniform(0, 1, 2) * image.shape[1::-1]


def darken_cars(rng: Generator, image: Picture, boxes: Boxes) -> Picture:
    """Paint some of the cars dark: their form stays, its contrast shrinks."""
    brightness = np.ones(image.shape[:2], np.float32)
    for box in boxes[rng.random(len(boxes)) < _DARK_CARS]:
        # Paint ends a little inside the box.
        painted = box * (1, 1, 0.97, 0.94, 1)
        outline = _fixed(box_corners(painted[None])[0])
        darkness = rng.uniform(0.2, 0.6)
        cv2.fillPoly(brightness, [outline], darkness, cv2.LINE_AA, _SHIFT)
    return _lit(image, brightness[:, :, None])


def cast_shadow(rng: Generator, image: Picture, middle: Point, car_px: float) -> Picture:
    """Darken a straight-sided area of one to eight cars' lengths with a hard or soft edge."""
    log_sides = rng.uniform(np.log(1.0), np.log(8.0), 2)
    sides = car_px * np.exp(log_sides)
    rectangle = (middle.tolist(), sides.tolist(), rng.uniform(0, 180))
    corners = cv2.boxPoints(rectangle)
    corners = corners + rng.normal(0, 0.15, corners.shape) * sides.min()
    inside = np.zeros(image.shape[:2], np.float32)
    cv2.fillPoly(inside, [_fixed(corners)], 1.0, cv2.LINE_AA, _SHIFT)
    softness = rng.uniform(0.3, 1.5)
    inside = np.asarray(cv2.GaussianBlur(inside, (0, 0), softness), np.float32)
    # Only the blue sky lights a shadow.
    sky = np.array([0.94, 1.0, 1.08], np.float32)
    tint = sky * np.float32(rng.uniform(0.22, 0.6))
    return _lit(image, 1 + inside[:, :, None] * (tint - 1))


def draw_crown(rng: Generator, image: Picture, foot: Point, car_px: float) -> Picture:
    """Draw the branches of a bare tree, and their shadow beside them."""
    cover = np.zeros(image.shape[:2], np.float32)
    radius = car_px * rng.uniform(0.4, 1.3)
    n_branches = int(rng.integers(6, 25))
    for heading in rng.uniform(0, 2 * np.pi, n_branches):
        length_px = radius * rng.uniform(0.5, 1.0)
        _draw_branch(rng, cover, foot=foot, heading=heading, length_px=length_px, car_px=car_px)
    dx, dy = rng.normal(0, 0.5 * car_px, 2)
    move = np.array([[1, 0, dx], [0, 1, dy]])
    shadow = np.asarray(cv2.warpAffine(cover, move, image.shape[1::-1]), np.float32)
    darkness = np.float32(rng.uniform(0.1, 0.5))
    image = _lit(image, 1 - darkness * shadow[:, :, None])
    bark_rgb = rng.uniform(50, 150) + rng.normal(0, 8, 3)
    bark = np.clip(bark_rgb, 0, 255).astype(np.float32)
    opacity = np.float32(rng.uniform(0.3, 0.8)) * cover[:, :, None]
    blend = image * (1 - opacity) + bark * opacity
    return np.clip(blend + 0.5, 0, 255).astype(np.uint8)


def _draw_branch(
    rng: Generator,
    cover: Layer,
    foot: Point,
    heading: float,
    length_px: float,
    car_px: float,
) -> None:
    """Draw one crooked branch, thinner than a pixel where the cars are short."""
    bends = heading + np.cumsum(rng.normal(0, 0.35, 4))
    directions = np.stack([np.cos(bends), np.sin(bends)], axis=1)
    steps = directions * length_px / 4
    bend_points = np.cumsum(steps, axis=0)
    path = foot + np.concatenate([np.zeros((1, 2)), bend_points])
    width_px = car_px * rng.uniform(0.015, 0.06)
    strength = float(min(1.0, width_px))
    line = np.zeros_like(cover)
    cv2.polylines(
        line,
        [_fixed(path)],
        isClosed=False,
        color=strength,
        thickness=max(1, round(width_px)),
        lineType=cv2.LINE_AA,
        shift=_SHIFT,
    )
    np.maximum(cover, line, out=cover)


def _fixed(points: Points) -> NDArray[np.int32]:
    return np.asarray(np.round(points * (1 << _SHIFT)), np.int32)


def _lit(image: Picture, factor: Layer) -> Picture:
    return np.asarray(np.clip(image * factor + 0.5, 0, 255), np.uint8)
