"""Yards full of equal things that have the shape of cars but not their size."""

from __future__ import annotations

import math
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from research.scenes.fleet import Fleet, VehicleModel
from research.scenes.painter import Painter
from research.scenes.sprites import Sun
from research.scenes.world import Box, Frame, Material, PlacedVehicle, Rgb, Surface, World

Yard = Literal["lorries", "buses", "caravans", "containers", "boats", "roof units"]
# Length and width of one thing, metres.
YARDS: dict[Yard, tuple[float, float]] = {
    "lorries": (16.0, 2.55),
    "buses": (12.0, 2.55),
    "caravans": (7.0, 2.3),
    "containers": (6.06, 2.44),
    "boats": (9.0, 3.0),
    "roof units": (2.4, 1.2),
}
EQUAL_CARS = (4.6, 1.85)
"""Length and width of the hire cars of ``paint_yard``, metres: all of one make and paint."""

_WHITE: Rgb = (226, 228, 228)
_BODIES: dict[str, str] = {"lorries": "semitrailer", "buses": "bus", "caravans": "caravan"}
_GROUND: dict[str, tuple[Rgb, Material]] = {
    "boats": ((62, 92, 104), Material.WATER),
    "roof units": ((150, 146, 140), Material.GRAVEL),
}
_PAINTS: tuple[Rgb, ...] = (
    _WHITE,
    (150, 60, 50),
    (52, 88, 130),
    (196, 140, 60),
    (120, 124, 128),
)


def paint_yard(
    yard: Yard | Literal["equal cars"], gsd_m_per_px: float, side_px: int, *, seed: int = 0
) -> NDArray[np.uint8]:
    """Paint rows of one kind of thing, all of the same size.

    Args:
        yard: the kind.
        gsd_m_per_px: size of a pixel on the ground.
        side_px: side of the image.
        seed: of places left free, colours and light.

    Returns:
        ``[side, side, 3]`` uint8 RGB.
    """
    rng = np.random.default_rng(seed)
    extent = side_px * gsd_m_per_px
    length, width = EQUAL_CARS if yard == "equal cars" else YARDS[yard]
    rgb, material = _GROUND.get(yard, ((98, 98, 100), Material.ASPHALT))
    corners = [(-9, -9), (extent + 9, -9), (extent + 9, extent + 9), (-9, extent + 9)]
    world = World(surfaces=[Surface(np.array(corners, dtype=np.float64), rgb, material)])
    turn = float(rng.uniform(0.1, 0.5))
    middle = Frame(extent / 2, extent / 2, turn)
    fleet = Fleet(4.6, rng)
    reach = extent / math.sqrt(2) + length
    for x in np.arange(-reach, reach, width * 1.45):
        for y in np.arange(-reach, reach, length * 1.35):
            # Some places are free.
            if rng.random() < 0.15:
                continue
            frame = middle.at(
                x + rng.uniform(-0.1, 0.1),
                y + rng.uniform(-0.3, 0.3),
                math.pi / 2 + rng.normal(0, 0.02),
            )
            if yard == "equal cars":
                _place_vehicle(world, frame, "small-vehicle", "sedan", (length, width), _WHITE)
            elif yard in _BODIES:
                body = _BODIES[yard]
                paint = fleet.large(body).paint
                _place_vehicle(world, frame, "large-vehicle", body, (length, width), paint)
            elif yard == "containers":
                paint = _PAINTS[rng.integers(len(_PAINTS))]
                outline = _outline(yard, frame, length, width)
                world.boxes.append(Box(outline, 2.6, paint))
            else:
                _place_thing(world, frame, yard, length, width)
    return _photograph(world, gsd_m_per_px, side_px, rng)


def _place_vehicle(
    world: World,
    frame: Frame,
    kind: Literal["small-vehicle", "large-vehicle"],
    body: str,
    size_m: tuple[float, float],
    paint: Rgb,
) -> None:
    """Place a vehicle of a given length and width."""
    length, width = size_m
    model = VehicleModel(kind, body, length_m=length, width_m=width, paint=paint)
    world.vehicles.append(PlacedVehicle(model, frame.x, y=frame.y, angle=frame.angle))


def _place_thing(world: World, frame: Frame, yard: Yard, length: float, width: float) -> None:
    """Place a boat or a roof unit: something dark in its middle resembles windows."""
    height = 1.0
    world.boxes.append(Box(_outline(yard, frame, length, width), height, _WHITE))
    inner = frame.at(-0.08 * length, 0)
    outline = _outline("containers", inner, 0.4 * length, 0.6 * width)
    world.boxes.append(Box(outline, height + 0.05, (70, 74, 80)))


def _outline(yard: Yard, frame: Frame, length: float, width: float) -> NDArray[np.float64]:
    """Compute the corners of a thing; boats have a pointed bow."""
    half = length / 2
    side = width / 2
    if yard != "boats":
        return frame.points([(half, side), (-half, side), (-half, -side), (half, -side)])
    tip = (half, 0.0)
    shoulder = (0.55 * half, 0.75 * side)
    beam = (0.15 * half, side)
    stern = (-half, 0.85 * side)
    port = [shoulder, beam, stern]
    starboard = [(x, -y) for x, y in reversed(port)]
    return frame.points([tip, *port, *starboard])


def _photograph(
    world: World, gsd_m_per_px: float, side_px: int, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Paint a world at twice the resolution, reduce it and add noise."""
    over = 2
    painter = Painter(world, Sun(1.0, math.radians(48)), rng=rng, px_per_m=over / gsd_m_per_px)
    tile = painter.paint(0.0, 0.0, side_px * over, side_px * over)
    image = cv2.resize(tile.rgb, (side_px, side_px), interpolation=cv2.INTER_AREA)
    noisy = image + rng.normal(0, 3, image.shape)
    return np.asarray(np.clip(noisy, 0, 255), dtype=np.uint8)
