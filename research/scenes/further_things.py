"""Further things that a detector may take for cars: tombs, seats, animals, carts and machines."""

from __future__ import annotations

import math

from research.scenes.things import (
    DARK,
    GREEN,
    HARD,
    HULL,
    STONE,
    WHITE,
    WHOLE,
    Part,
    Shape,
    Thing,
    rectangle,
    slats,
)
from research.scenes.world import Material

_CORNERS_OF_ELLIPSE = 14


def ellipse(length: float = 1.0, width: float = 1.0, x: float = 0.0, y: float = 0.0) -> Shape:
    """Build an ellipse with its centre at (x, y)."""
    corners = []
    for number in range(_CORNERS_OF_ELLIPSE):
        angle = 2 * math.pi * number / _CORNERS_OF_ELLIPSE
        corners.append((x + length / 2 * math.cos(angle), y + width / 2 * math.sin(angle)))
    return tuple(corners)


def chamfered(x0: float, y0: float, x1: float, y1: float, share: float = 0.12) -> Shape:
    """Build a rectangle whose corners are cut by a share of its sides."""
    dx = (x1 - x0) * share
    dy = (y1 - y0) * share
    return (
        (x0 + dx, y0),
        (x1 - dx, y0),
        (x1, y0 + dy),
        (x1, y1 - dy),
        (x1 - dx, y1),
        (x0 + dx, y1),
        (x0, y1 - dy),
        (x0, y0 + dy),
    )


FURTHER_THINGS: dict[str, Thing] = {
    "hospital beds": Thing(
        lengths_m=(2.0, 2.2),
        width_per_length=(0.42, 0.48),
        height_m=0.6,
        paints=(
            WHITE,
            (190, 210, 225),
        ),
        parts=(
            Part(chamfered(-0.5, -0.5, 0.5, 0.5)),
            Part(rectangle(-0.46, -0.42, 0.3, 0.42), 1.1),
            Part(rectangle(0.32, -0.34, 0.47, 0.34), 1.2),
            Part(rectangle(-0.5, -0.5, -0.47, 0.5), 0.5),
        ),
        grounds=(Material.PAVING, Material.PLAIN),
    ),
    "growing tables": Thing(
        lengths_m=(3.0, 9.0),
        width_per_length=(0.18, 0.4),
        height_m=0.8,
        paints=((150, 150, 145),),
        parts=(
            WHOLE,
            Part(rectangle(-0.48, -0.42, 0.48, 0.42), rgb=(70, 120, 50)),
            *slats(8, 1.2),
        ),
        grounds=(Material.PLAIN, Material.GRAVEL),
        gap=0.4,
    ),
    "parasols": Thing(
        lengths_m=(2.0, 3.2),
        width_per_length=(0.96, 1.0),
        height_m=2.2,
        paints=(
            (200, 60, 50),
            (240, 230, 200),
            (60, 110, 170),
            WHITE,
        ),
        parts=(
            Part(ellipse()),
            Part(((0, 0), (0.5, 0), (0.35, 0.35)), 0.85),
            Part(((0, 0), (-0.35, 0.35), (-0.5, 0)), 1.1),
            Part(((0, 0), (-0.35, -0.35), (0, -0.5)), 0.8),
        ),
        grounds=(Material.SOIL, Material.PAVING),
        gap=0.8,
        one_paint=False,
    ),
    "sheep": Thing(
        lengths_m=(1.0, 1.3),
        width_per_length=(0.4, 0.5),
        height_m=0.8,
        paints=(
            (225, 220, 205),
            (200, 195, 180),
        ),
        parts=(
            Part(ellipse()),
            Part(ellipse(0.25, 0.5, 0.42, 0), 0.4),
        ),
        grounds=GREEN,
        gap=1.5,
        pixels=(14.0, 36.0),
    ),
    "cows": Thing(
        lengths_m=(2.0, 2.5),
        width_per_length=(0.3, 0.36),
        height_m=1.4,
        paints=(
            (110, 70, 45),
            (30, 28, 28),
            (230, 225, 215),
        ),
        parts=(
            Part(ellipse(0.85, 1, -0.07, 0)),
            Part(ellipse(0.25, 0.5, 0.4, 0), 0.8),
            Part(ellipse(0.3, 0.5, -0.1, 0.1), rgb=(225, 222, 215)),
        ),
        grounds=GREEN,
        gap=1.2,
        one_paint=False,
    ),
    "stadium seats": Thing(
        lengths_m=(0.42, 0.5),
        width_per_length=(0.9, 1.0),
        height_m=0.5,
        paints=(
            (30, 70, 150),
            (190, 40, 40),
            (220, 180, 40),
        ),
        parts=(
            Part(chamfered(-0.5, -0.5, 0.5, 0.5, 0.2)),
            Part(rectangle(-0.5, -0.45, -0.3, 0.45), 0.7),
        ),
        grounds=(Material.PLAIN,),
        gap=0.15,
        pixels=(12.0, 40.0),
    ),
    "beehives": Thing(
        lengths_m=(0.5, 0.6),
        width_per_length=(0.75, 0.9),
        height_m=0.6,
        paints=(
            WHITE,
            (150, 190, 210),
            (200, 180, 90),
        ),
        parts=(
            WHOLE,
            Part(rectangle(-0.42, -0.4, 0.42, 0.4), 1.08),
        ),
        grounds=GREEN,
        gap=1.6,
        one_paint=False,
        pixels=(12.0, 36.0),
    ),
    "skylights": Thing(
        lengths_m=(1.2, 2.4),
        width_per_length=(0.5, 0.85),
        height_m=0.4,
        paints=(
            (120, 140, 150),
            (200, 215, 220),
        ),
        parts=(
            WHOLE,
            Part(rectangle(-0.44, -0.4, 0.44, 0.4), 0.75),
            Part(rectangle(-0.44, -0.03, 0.44, 0.03), 1.3),
        ),
        grounds=(Material.GRAVEL, Material.PLAIN),
        gap=1.2,
    ),
    "picnic tables": Thing(
        lengths_m=(1.8, 2.0),
        width_per_length=(0.75, 0.9),
        height_m=0.75,
        paints=(
            (150, 110, 70),
            (120, 95, 70),
        ),
        parts=(
            Part(rectangle(-0.5, -0.24, 0.5, 0.24)),
            Part(rectangle(-0.5, -0.5, 0.5, -0.36), 0.85),
            Part(rectangle(-0.5, 0.36, 0.5, 0.5), 0.85),
            Part(rectangle(-0.36, -0.46, -0.3, 0.46), 0.7),
            Part(rectangle(0.3, -0.46, 0.36, 0.46), 0.7),
        ),
        grounds=(*GREEN, Material.PAVING),
        gap=1.0,
    ),
    "cross tombs": Thing(
        lengths_m=(1.9, 2.3),
        width_per_length=(0.45, 0.55),
        height_m=0.5,
        paints=(
            STONE,
            (90, 88, 90),
            WHITE,
        ),
        parts=(
            WHOLE,
            Part(rectangle(-0.45, -0.42, 0.3, 0.42), rgb=(90, 120, 60)),
            Part(rectangle(0.32, -0.42, 0.5, 0.42), 1.1),
            Part(rectangle(0.36, -0.05, 0.48, 0.05), 0.6),
        ),
        grounds=(*GREEN, Material.GRAVEL),
        gap=0.5,
        one_paint=False,
    ),
    "tomb chests": Thing(
        lengths_m=(2.2, 2.6),
        width_per_length=(0.4, 0.46),
        height_m=1.0,
        paints=(
            (140, 138, 132),
            (110, 112, 110),
        ),
        parts=(
            WHOLE,
            Part(chamfered(-0.44, -0.38, 0.44, 0.38, 0.2), 1.12),
            Part(rectangle(-0.3, -0.06, 0.34, 0.06), 0.8),
            Part(rectangle(0.1, -0.25, 0.18, 0.25), 0.8),
        ),
        grounds=(*GREEN, Material.PAVING),
        gap=0.7,
    ),
    "portable toilets": Thing(
        lengths_m=(1.1, 1.25),
        width_per_length=(0.9, 1.0),
        height_m=2.3,
        paints=(
            (40, 90, 160),
            (60, 130, 90),
            (200, 120, 50),
        ),
        parts=(
            WHOLE,
            Part(rectangle(-0.42, -0.42, 0.42, 0.42), 1.15),
            Part(ellipse(0.2, 0.2, 0.25, 0.2), 0.5),
        ),
        grounds=(*HARD, *GREEN),
        gap=0.15,
        pixels=(12.0, 40.0),
    ),
    "shopping trolleys": Thing(
        lengths_m=(0.95, 1.1),
        width_per_length=(0.52, 0.6),
        height_m=1.0,
        paints=((170, 172, 175),),
        parts=(
            Part(rectangle(-0.5, -0.4, 0.45, 0.4), 0.8),
            Part(rectangle(-0.42, -0.32, 0.38, 0.32), 0.6),
            Part(rectangle(0.42, -0.5, 0.5, 0.5), rgb=(190, 40, 40)),
        ),
        grounds=HARD,
        gap=0.5,
        pixels=(12.0, 40.0),
    ),
    "tyres": Thing(
        lengths_m=(0.65, 1.2),
        width_per_length=(0.96, 1.0),
        height_m=0.4,
        paints=((32, 32, 34),),
        parts=(
            Part(ellipse()),
            Part(ellipse(0.5, 0.5), 0.3),
            Part(ellipse(0.4, 0.4), 2.5),
        ),
        grounds=HARD,
        gap=0.2,
        pixels=(12.0, 40.0),
    ),
    "lane floats": Thing(
        lengths_m=(1.0, 2.5),
        width_per_length=(0.12, 0.2),
        height_m=0.1,
        paints=(
            (210, 50, 40),
            (240, 240, 235),
            (40, 80, 170),
        ),
        parts=(
            WHOLE,
            *slats(6, 0.8),
        ),
        grounds=(Material.WATER,),
        gap=4.0,
        pixels=(16.0, 50.0),
    ),
    "pedal boats": Thing(
        lengths_m=(2.6, 3.2),
        width_per_length=(0.5, 0.6),
        height_m=0.9,
        paints=(
            (220, 200, 60),
            (60, 110, 180),
            (220, 220, 215),
            (200, 60, 60),
        ),
        parts=(
            Part(chamfered(-0.5, -0.5, 0.5, 0.5, 0.2), 0.9),
            Part(rectangle(-0.1, -0.4, 0.25, 0.4), 0.5),
            Part(rectangle(-0.1, -0.4, -0.02, 0.4), 1.2),
            Part(rectangle(0.25, -0.46, 0.5, 0.46), 1.05),
        ),
        grounds=(Material.WATER,),
        gap=0.3,
        one_paint=False,
    ),
    "jet skis": Thing(
        lengths_m=(2.8, 3.4),
        width_per_length=(0.32, 0.38),
        height_m=0.9,
        paints=(
            (40, 44, 50),
            (200, 50, 40),
            (230, 230, 225),
        ),
        parts=(
            Part(HULL),
            Part(rectangle(-0.4, -0.2, 0.05, 0.2), 0.4),
            Part(rectangle(0.08, -0.28, 0.16, 0.28), rgb=(40, 40, 42)),
        ),
        grounds=(Material.WATER, Material.PAVING),
        gap=0.6,
        one_paint=False,
    ),
    "quads": Thing(
        lengths_m=(1.8, 2.2),
        width_per_length=(0.55, 0.65),
        height_m=1.0,
        paints=(
            (190, 40, 35),
            (50, 90, 50),
            (40, 70, 150),
            DARK,
        ),
        parts=(
            Part(rectangle(-0.45, -0.5, -0.2, -0.25), rgb=(25, 25, 25)),
            Part(rectangle(-0.45, 0.25, -0.2, 0.5), rgb=(25, 25, 25)),
            Part(rectangle(0.2, -0.5, 0.45, -0.25), rgb=(25, 25, 25)),
            Part(rectangle(0.2, 0.25, 0.45, 0.5), rgb=(25, 25, 25)),
            Part(rectangle(-0.4, -0.24, 0.42, 0.24)),
            Part(rectangle(-0.3, -0.18, 0.0, 0.18), rgb=(35, 35, 35)),
            Part(rectangle(0.1, -0.36, 0.15, 0.36), 0.5),
        ),
        grounds=HARD,
        gap=0.5,
        one_paint=False,
    ),
    "go karts": Thing(
        lengths_m=(1.8, 2.1),
        width_per_length=(0.6, 0.72),
        height_m=0.6,
        paints=(
            (200, 40, 40),
            (40, 80, 180),
            (230, 190, 40),
            (40, 140, 70),
        ),
        parts=(
            Part(rectangle(-0.45, -0.5, -0.25, 0.5), rgb=(25, 25, 25)),
            Part(rectangle(0.25, -0.5, 0.42, 0.5), rgb=(25, 25, 25)),
            Part(chamfered(-0.5, -0.3, 0.5, 0.3)),
            Part(rectangle(-0.3, -0.2, -0.05, 0.2), rgb=(30, 30, 30)),
            Part(ellipse(0.14, 0.2, 0.08, 0), rgb=(20, 20, 20)),
        ),
        grounds=(Material.ASPHALT, Material.PAVING),
        gap=0.5,
        one_paint=False,
    ),
    "toy cars": Thing(
        lengths_m=(1.1, 1.4),
        width_per_length=(0.55, 0.62),
        height_m=0.6,
        paints=(
            (210, 50, 45),
            (50, 90, 190),
            (240, 240, 240),
            (240, 150, 180),
        ),
        parts=(
            Part(chamfered(-0.5, -0.5, 0.5, 0.5, 0.15)),
            Part(rectangle(0.05, -0.42, 0.16, 0.42), rgb=(50, 60, 70)),
            Part(rectangle(-0.3, -0.36, 0.04, 0.36), rgb=(40, 40, 42)),
            Part(rectangle(-0.46, -0.42, -0.34, 0.42), 0.85),
        ),
        grounds=(Material.PAVING, Material.ASPHALT, Material.PLAIN),
        gap=0.6,
        one_paint=False,
    ),
    "lawn mowers": Thing(
        lengths_m=(1.8, 2.2),
        width_per_length=(0.5, 0.6),
        height_m=1.1,
        paints=(
            (60, 130, 60),
            (210, 90, 40),
        ),
        parts=(
            Part(chamfered(-0.5, -0.4, 0.5, 0.4)),
            Part(rectangle(-0.35, -0.28, -0.1, 0.28), rgb=(230, 200, 40)),
            Part(rectangle(-0.1, -0.5, 0.2, 0.5), 0.7),
            Part(rectangle(0.05, -0.12, 0.12, 0.12), rgb=(30, 30, 30)),
        ),
        grounds=(*GREEN, Material.PAVING),
        gap=0.5,
    ),
    "generators": Thing(
        lengths_m=(2.4, 3.6),
        width_per_length=(0.36, 0.46),
        height_m=1.6,
        paints=(
            (210, 180, 60),
            (220, 220, 215),
            (60, 110, 80),
        ),
        parts=(
            WHOLE,
            Part(rectangle(-0.46, -0.4, -0.2, 0.4), 0.7),
            Part(rectangle(0.1, -0.3, 0.3, 0.3), 0.55),
            Part(ellipse(0.08, 0.18, 0.4, 0), 0.3),
        ),
        grounds=HARD,
        gap=0.5,
    ),
    "tractors": Thing(
        lengths_m=(3.6, 4.6),
        width_per_length=(0.45, 0.55),
        height_m=2.6,
        paints=(
            (50, 120, 50),
            (190, 40, 35),
            (40, 90, 160),
        ),
        parts=(
            Part(rectangle(-0.45, -0.5, -0.05, -0.28), rgb=(25, 25, 25)),
            Part(rectangle(-0.45, 0.28, -0.05, 0.5), rgb=(25, 25, 25)),
            Part(rectangle(0.2, -0.42, 0.42, -0.25), rgb=(25, 25, 25)),
            Part(rectangle(0.2, 0.25, 0.42, 0.42), rgb=(25, 25, 25)),
            Part(rectangle(-0.4, -0.3, 0.05, 0.3), 1.0),
            Part(rectangle(-0.36, -0.26, 0.0, 0.26), rgb=(225, 225, 220)),
            Part(rectangle(0.05, -0.18, 0.5, 0.18)),
        ),
        grounds=(*HARD, Material.SOIL),
        gap=0.5,
    ),
    "teardrop caravans": Thing(
        lengths_m=(3.0, 4.2),
        width_per_length=(0.42, 0.5),
        height_m=1.7,
        paints=(
            (200, 205, 208),
            (110, 150, 160),
            WHITE,
        ),
        parts=(
            Part(
                (
                    (-0.5, -0.4),
                    (-0.3, -0.5),
                    (0.3, -0.45),
                    (0.42, -0.2),
                    (0.42, 0.2),
                    (0.3, 0.45),
                    (-0.3, 0.5),
                    (-0.5, 0.4),
                )
            ),
            Part(rectangle(-0.1, -0.15, 0.08, 0.15), 0.6),
            Part(rectangle(0.42, -0.04, 0.5, 0.04), 0.5),
        ),
        grounds=(*GREEN, *HARD),
        gap=0.6,
    ),
}
