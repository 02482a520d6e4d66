"""Places full of equal things of a car's shape and not of its size, drawn with the scene's own painter."""

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
YARDS: dict[Yard, tuple[float, float]] = {  # length and width of one, metres
    "lorries": (16.0, 2.55),
    "buses": (12.0, 2.55),
    "caravans": (7.0, 2.3),
    "containers": (6.06, 2.44),
    "boats": (9.0, 3.0),
    "roof units": (2.4, 1.2),
}
EQUAL_CARS = (4.6, 1.85)
"""Length and width of the hire cars of ``paint_yard``, metres: of one make and paint."""

_BODIES: dict[str, str] = {"lorries": "semitrailer", "buses": "bus", "caravans": "caravan"}
_GROUND: dict[str, tuple[Rgb, Material]] = {
    "boats": ((62, 92, 104), Material.WATER),
    "roof units": ((150, 146, 140), Material.GRAVEL),
}
_PAINTS: tuple[Rgb, ...] = (
    (226, 228, 228),
    (150, 60, 50),
    (52, 88, 130),
    (196, 140, 60),
    (120, 124, 128),
)


def _outline(yard: Yard, frame: Frame, length: float, width: float) -> NDArray[np.float64]:
    half = length / 2
    side = width / 2
    if yard == "boats":  # a pointed bow
        bow = [(half, 0.0), (0.55 * half, 0.75 * side), (0.15 * half, side)]
        return frame.points(
            [*bow, (-half, 0.85 * side), (-half, -0.85 * side), *((x, -y) for x, y in bow[:0:-1])]
        )
    return frame.points([(half, side), (-half, side), (-half, -side), (half, -side)])


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
    around = np.array(
        [(-9, -9), (extent + 9, -9), (extent + 9, extent + 9), (-9, extent + 9)], dtype=np.float64
    )
    world = World(surfaces=[Surface(around, rgb, material)])
    turn = float(rng.uniform(0.1, 0.5))
    fleet = Fleet(4.6, rng)
    pitch_x = width * 1.45
    pitch_y = length * 1.35
    reach = extent / math.sqrt(2) + length
    for x in np.arange(-reach, reach, pitch_x):
        for y in np.arange(-reach, reach, pitch_y):
            if rng.random() < 0.15:
                continue
            middle = Frame(extent / 2, extent / 2, turn)
            frame = middle.at(
                x + rng.uniform(-0.1, 0.1),
                y + rng.uniform(-0.3, 0.3),
                math.pi / 2 + rng.normal(0, 0.02),
            )
            if yard == "equal cars":
                model = VehicleModel(
                    "small-vehicle", "sedan", length_m=length, width_m=width, paint=(226, 228, 228)
                )
                world.vehicles.append(PlacedVehicle(model, frame.x, y=frame.y, angle=frame.angle))
            elif yard in _BODIES:
                paint = fleet.large(_BODIES[yard]).paint
                model = VehicleModel(
                    "large-vehicle", _BODIES[yard], length_m=length, width_m=width, paint=paint
                )
                world.vehicles.append(PlacedVehicle(model, frame.x, y=frame.y, angle=frame.angle))
            else:
                paint = _PAINTS[rng.integers(len(_PAINTS))] if yard == "containers" else _PAINTS[0]
                height = 2.6 if yard == "containers" else 1.0
                world.boxes.append(Box(_outline(yard, frame, length, width), height, paint))
                # a cockpit, a fan: something dark in the middle, as windows are
                if yard != "containers":
                    inner = _outline(
                        "containers", frame.at(-0.08 * length, 0), 0.4 * length, 0.6 * width
                    )
                    world.boxes.append(Box(inner, height + 0.05, (70, 74, 80)))
    over = 2
    painter = Painter(world, Sun(1.0, math.radians(48)), rng=rng, px_per_m=over / gsd_m_per_px)
    tile = painter.paint(0.0, 0.0, side_px * over, side_px * over)
    image = cv2.resize(tile.rgb, (side_px, side_px), interpolation=cv2.INTER_AREA)
    return np.asarray(np.clip(image + rng.normal(0, 3, image.shape), 0, 255), dtype=np.uint8)
