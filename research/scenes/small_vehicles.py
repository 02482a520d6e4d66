"""Small vehicles that are not cars: karts, carts, quads, motorcycles, tuk-tuks and toys.

To a network they are the hardest things: they have wheels, seats, bonnets and paints as cars do.
"""

from __future__ import annotations

from research.scenes.further_things import chamfered, ellipse
from research.scenes.things import DARK, GREEN, HARD, WHITE, WHOLE, Part, Thing, rectangle
from research.scenes.world import Material, Rgb

BRIGHT_PAINTS: tuple[Rgb, ...] = (
    (190, 40, 38),
    (40, 80, 170),
    (225, 185, 45),
    (50, 130, 70),
    (228, 227, 222),
    (40, 42, 46),
    (230, 120, 40),
)
"""Paints of small vehicles."""
_GLASS: Rgb = (52, 60, 68)
_TYRE: Rgb = (26, 26, 27)
_SEAT: Rgb = (38, 38, 40)


def _wheels(front: float, rear: float, *, length: float, width: float) -> tuple[Part, ...]:
    """Build four wheels; the arguments are shares of the thing's length and width."""
    parts = []
    for x in (front, rear):
        for y in (-0.5 + width / 2, 0.5 - width / 2):
            wheel = rectangle(x - length / 2, y - width / 2, x + length / 2, y + width / 2)
            parts.append(Part(wheel, rgb=_TYRE))
    return tuple(parts)


SMALL_VEHICLES: dict[str, Thing] = {
    "open bumper cars": Thing(
        lengths_m=(1.75, 2.1),
        width_per_length=(0.55, 0.66),
        height_m=0.9,
        paints=BRIGHT_PAINTS,
        parts=(
            Part(chamfered(-0.5, -0.5, 0.5, 0.5, 0.25), rgb=DARK),
            Part(chamfered(-0.45, -0.42, 0.45, 0.42, 0.25)),
            Part(chamfered(-0.24, -0.3, 0.1, 0.3), rgb=_SEAT),
            Part(ellipse(0.24, 0.3, 0.3, 0.0), 1.2),
            Part(rectangle(0.08, -0.08, 0.12, 0.12), rgb=(120, 120, 122)),
        ),
        grounds=(Material.PAVING, Material.ASPHALT, Material.PLAIN),
        gap=0.6,
        one_paint=False,
    ),
    "pole bumper cars": Thing(
        lengths_m=(1.8, 2.2),
        width_per_length=(0.52, 0.6),
        height_m=1.0,
        paints=BRIGHT_PAINTS,
        parts=(
            Part(ellipse(), rgb=(30, 30, 32)),
            Part(ellipse(0.9, 0.84)),
            Part(rectangle(-0.2, -0.3, 0.12, 0.3), rgb=_SEAT),
            Part(rectangle(0.12, -0.3, 0.18, 0.3), rgb=_GLASS),
            Part(ellipse(0.06, 0.1, -0.4, 0.0), rgb=(200, 200, 200)),
        ),
        grounds=(Material.PLAIN, Material.PAVING),
        gap=0.6,
        one_paint=False,
    ),
    "racing karts": Thing(
        lengths_m=(1.75, 2.0),
        width_per_length=(0.68, 0.78),
        height_m=0.5,
        paints=BRIGHT_PAINTS,
        parts=(
            Part(rectangle(-0.42, -0.24, 0.42, 0.24), rgb=(60, 62, 64)),
            *_wheels(0.3, -0.32, length=0.16, width=0.14),
            Part(chamfered(0.34, -0.34, 0.5, 0.34)),
            Part(rectangle(-0.16, -0.48, 0.18, -0.3)),
            Part(rectangle(-0.16, 0.3, 0.18, 0.48)),
            Part(ellipse(0.3, 0.34, -0.12, 0.0), rgb=_SEAT),
            Part(rectangle(-0.5, -0.36, -0.44, 0.36), rgb=_TYRE),
        ),
        grounds=(Material.ASPHALT, Material.PAVING),
        gap=0.5,
        one_paint=False,
    ),
    "hire karts": Thing(
        lengths_m=(1.9, 2.2),
        width_per_length=(0.58, 0.68),
        height_m=0.6,
        paints=BRIGHT_PAINTS,
        parts=(
            Part(chamfered(-0.5, -0.5, 0.5, 0.5, 0.2), rgb=_TYRE),
            Part(chamfered(-0.44, -0.4, 0.44, 0.4, 0.2)),
            Part(ellipse(0.32, 0.46, -0.14, 0.0), rgb=_SEAT),
            Part(rectangle(0.12, -0.16, 0.18, 0.16), rgb=(20, 20, 20)),
        ),
        grounds=(Material.ASPHALT,),
        gap=0.5,
        one_paint=False,
    ),
    "children's jeeps": Thing(
        lengths_m=(1.1, 1.5),
        width_per_length=(0.52, 0.62),
        height_m=0.7,
        paints=BRIGHT_PAINTS,
        parts=(
            WHOLE,
            *_wheels(0.3, -0.3, length=0.22, width=0.14),
            Part(rectangle(0.08, -0.38, 0.14, 0.38), rgb=_GLASS),
            Part(rectangle(-0.34, -0.34, 0.06, 0.34), rgb=_SEAT),
            Part(rectangle(0.16, -0.3, 0.46, 0.3), 1.15),
        ),
        grounds=(*HARD, Material.LAWN),
        gap=0.6,
        one_paint=False,
    ),
    "carousel cars": Thing(
        lengths_m=(1.4, 2.0),
        width_per_length=(0.46, 0.56),
        height_m=0.8,
        paints=BRIGHT_PAINTS,
        parts=(
            Part(chamfered(-0.5, -0.5, 0.5, 0.5, 0.16)),
            Part(rectangle(0.1, -0.4, 0.2, 0.4), rgb=_GLASS),
            Part(rectangle(-0.3, -0.36, 0.08, 0.36), rgb=_SEAT),
            Part(rectangle(-0.12, -0.36, -0.06, 0.36), 1.1),
            Part(rectangle(0.46, -0.4, 0.5, -0.24), rgb=WHITE),
            Part(rectangle(0.46, 0.24, 0.5, 0.4), rgb=WHITE),
        ),
        grounds=(Material.PLAIN, Material.PAVING),
        gap=0.7,
        one_paint=False,
    ),
    "roofed golf carts": Thing(
        lengths_m=(2.3, 2.8),
        width_per_length=(0.45, 0.52),
        height_m=1.8,
        paints=(WHITE, (205, 196, 170), (60, 62, 66), (90, 120, 90)),
        parts=(
            Part(chamfered(-0.5, -0.46, 0.5, 0.46)),
            Part(rectangle(0.26, -0.4, 0.31, 0.4), rgb=_GLASS),
            Part(chamfered(-0.34, -0.5, 0.24, 0.5), rgb=(226, 225, 220)),
            Part(rectangle(-0.48, -0.34, -0.36, -0.02), rgb=(120, 40, 40)),
            Part(rectangle(-0.48, 0.02, -0.36, 0.34), rgb=(40, 60, 110)),
        ),
        grounds=(Material.LAWN, Material.ASPHALT, Material.PAVING),
        gap=0.4,
    ),
    "long golf carts": Thing(
        lengths_m=(3.1, 4.0),
        width_per_length=(0.32, 0.4),
        height_m=1.9,
        paints=(WHITE, (60, 90, 150), (205, 196, 170)),
        parts=(
            Part(chamfered(-0.5, -0.46, 0.5, 0.46)),
            Part(rectangle(0.3, -0.4, 0.33, 0.4), rgb=_GLASS),
            Part(chamfered(-0.42, -0.5, 0.28, 0.5, 0.06), rgb=(228, 226, 220)),
        ),
        grounds=(*HARD, Material.LAWN),
        gap=0.4,
    ),
    "side by sides": Thing(
        lengths_m=(2.8, 3.3),
        width_per_length=(0.48, 0.56),
        height_m=1.8,
        paints=BRIGHT_PAINTS,
        parts=(
            Part(rectangle(-0.44, -0.38, 0.5, 0.38)),
            *_wheels(0.33, -0.34, length=0.22, width=0.18),
            Part(rectangle(-0.5, -0.4, -0.26, 0.4), 0.5),
            Part(rectangle(-0.22, -0.36, 0.14, 0.36), rgb=_SEAT),
            Part(rectangle(-0.22, -0.34, -0.18, 0.34), rgb=(130, 130, 132)),
            Part(rectangle(0.1, -0.34, 0.14, 0.34), rgb=(130, 130, 132)),
        ),
        grounds=(*HARD, Material.SOIL),
        gap=0.5,
        one_paint=False,
    ),
    "quad bikes": Thing(
        lengths_m=(1.9, 2.3),
        width_per_length=(0.52, 0.6),
        height_m=1.1,
        paints=BRIGHT_PAINTS,
        parts=(
            Part(chamfered(-0.4, -0.26, 0.46, 0.26)),
            *_wheels(0.32, -0.32, length=0.28, width=0.24),
            Part(rectangle(-0.46, -0.4, -0.16, 0.4), 1.1),
            Part(rectangle(0.2, -0.4, 0.46, 0.4), 1.1),
            Part(ellipse(0.4, 0.24, -0.1, 0.0), rgb=_SEAT),
            Part(rectangle(0.14, -0.34, 0.18, 0.34), rgb=_TYRE),
        ),
        grounds=(*HARD, Material.SOIL),
        gap=0.5,
        one_paint=False,
    ),
    "motorcycles": Thing(
        lengths_m=(2.0, 2.3),
        width_per_length=(0.33, 0.4),
        height_m=1.1,
        paints=BRIGHT_PAINTS,
        parts=(
            Part(rectangle(-0.5, -0.12, 0.5, 0.12), rgb=_TYRE),
            Part(ellipse(0.34, 0.5, 0.12, 0.0)),
            Part(ellipse(0.34, 0.4, -0.2, 0.0), rgb=_SEAT),
            Part(rectangle(0.24, -0.5, 0.28, 0.5), rgb=(90, 90, 92)),
        ),
        grounds=HARD,
        gap=0.6,
        one_paint=False,
    ),
    "mopeds": Thing(
        lengths_m=(1.7, 1.95),
        width_per_length=(0.36, 0.42),
        height_m=1.1,
        paints=BRIGHT_PAINTS,
        parts=(
            Part(ellipse(1.0, 0.3), rgb=_TYRE),
            Part(ellipse(0.6, 0.6, -0.1, 0.0)),
            Part(ellipse(0.4, 0.4, -0.16, 0.0), rgb=_SEAT),
            Part(rectangle(0.26, -0.5, 0.31, 0.5), rgb=(60, 60, 62)),
        ),
        grounds=HARD,
        gap=0.4,
        one_paint=False,
    ),
    "tuk-tuks": Thing(
        lengths_m=(2.6, 3.0),
        width_per_length=(0.46, 0.52),
        height_m=1.7,
        paints=((40, 90, 60), (225, 190, 60), (40, 80, 150), DARK),
        parts=(
            Part(
                (
                    (-0.5, -0.5),
                    (0.2, -0.5),
                    (0.5, -0.16),
                    (0.5, 0.16),
                    (0.2, 0.5),
                    (-0.5, 0.5),
                )
            ),
            Part(rectangle(0.18, -0.34, 0.26, 0.34), rgb=_GLASS),
            Part(chamfered(-0.44, -0.46, 0.18, 0.46), 1.2),
        ),
        grounds=HARD,
        gap=0.4,
    ),
    "mobility scooters": Thing(
        lengths_m=(1.1, 1.5),
        width_per_length=(0.44, 0.54),
        height_m=1.0,
        paints=BRIGHT_PAINTS,
        parts=(
            Part(chamfered(-0.5, -0.5, 0.5, 0.5, 0.2)),
            Part(rectangle(-0.34, -0.36, 0.0, 0.36), rgb=_SEAT),
            Part(rectangle(0.24, -0.3, 0.3, 0.3), rgb=_TYRE),
        ),
        grounds=(Material.PAVING, Material.ASPHALT),
        gap=0.6,
        one_paint=False,
        pixels=(14.0, 45.0),
    ),
    "ride-on mowers": Thing(
        lengths_m=(1.7, 2.1),
        width_per_length=(0.48, 0.58),
        height_m=1.1,
        paints=((60, 130, 55), (215, 100, 40), (190, 40, 38)),
        parts=(
            Part(chamfered(-0.1, -0.3, 0.5, 0.3)),
            *_wheels(-0.26, 0.34, length=0.2, width=0.18),
            Part(chamfered(-0.2, -0.5, 0.22, 0.5), 0.7),
            Part(rectangle(-0.4, -0.24, -0.12, 0.24), rgb=(228, 200, 50)),
            Part(rectangle(-0.5, -0.36, -0.4, 0.36), 0.8),
        ),
        grounds=(Material.LAWN, Material.PAVING),
        gap=0.5,
    ),
    "wheelbarrows": Thing(
        lengths_m=(1.3, 1.5),
        width_per_length=(0.42, 0.5),
        height_m=0.6,
        paints=((60, 130, 60), (60, 90, 160), (120, 120, 118)),
        parts=(
            Part(rectangle(-0.5, -0.46, 0.0, -0.38), rgb=(120, 90, 60)),
            Part(rectangle(-0.5, 0.38, 0.0, 0.46), rgb=(120, 90, 60)),
            Part(chamfered(-0.2, -0.5, 0.36, 0.5, 0.2)),
            Part(chamfered(-0.14, -0.4, 0.3, 0.4, 0.2), 0.6),
            Part(rectangle(0.36, -0.08, 0.5, 0.08), rgb=_TYRE),
        ),
        grounds=(*GREEN, Material.SOIL, Material.GRAVEL),
        gap=0.6,
        pixels=(14.0, 45.0),
    ),
    "site dumpers": Thing(
        lengths_m=(3.0, 4.2),
        width_per_length=(0.46, 0.54),
        height_m=2.0,
        paints=((225, 175, 40), (215, 110, 40), (60, 120, 70)),
        parts=(
            Part(rectangle(-0.5, -0.34, 0.4, 0.34)),
            *_wheels(0.26, -0.28, length=0.24, width=0.2),
            Part(chamfered(0.04, -0.5, 0.5, 0.5)),
            Part(chamfered(0.1, -0.4, 0.44, 0.4), 0.5),
            Part(rectangle(-0.2, -0.24, -0.04, 0.24), rgb=_SEAT),
        ),
        grounds=(Material.SOIL, Material.GRAVEL),
        gap=0.5,
    ),
    "dune buggies": Thing(
        lengths_m=(2.5, 3.2),
        width_per_length=(0.54, 0.62),
        height_m=1.5,
        paints=BRIGHT_PAINTS,
        parts=(
            Part(rectangle(-0.46, -0.28, 0.46, 0.28), rgb=(70, 70, 72)),
            *_wheels(0.34, -0.32, length=0.24, width=0.2),
            Part(rectangle(0.14, -0.24, 0.5, 0.24)),
            Part(rectangle(-0.2, -0.3, 0.1, 0.3), rgb=_SEAT),
            Part(rectangle(-0.48, -0.2, -0.24, 0.2), 0.6),
        ),
        grounds=(Material.SOIL, Material.ASPHALT),
        gap=0.5,
        one_paint=False,
    ),
    "cargo bikes": Thing(
        lengths_m=(2.1, 2.6),
        width_per_length=(0.32, 0.42),
        height_m=1.0,
        paints=BRIGHT_PAINTS,
        parts=(
            Part(rectangle(-0.5, -0.06, 0.2, 0.06), rgb=_TYRE),
            Part(rectangle(0.08, -0.5, 0.5, 0.5)),
            Part(rectangle(0.12, -0.4, 0.46, 0.4), 0.6),
            Part(rectangle(-0.12, -0.36, -0.08, 0.36), rgb=(80, 80, 82)),
            Part(ellipse(0.16, 0.24, -0.28, 0.0), rgb=_SEAT),
        ),
        grounds=(Material.PAVING, Material.ASPHALT),
        gap=0.6,
        one_paint=False,
    ),
    "luggage trolleys": Thing(
        lengths_m=(2.4, 3.0),
        width_per_length=(0.48, 0.56),
        height_m=1.6,
        paints=((60, 80, 120), (130, 134, 138), (200, 60, 50)),
        parts=(
            WHOLE,
            Part(rectangle(-0.46, -0.44, 0.46, 0.44), 1.15),
            Part(rectangle(-0.46, -0.03, 0.46, 0.03), 0.7),
            Part(rectangle(0.46, -0.06, 0.5, 0.06), 0.5),
        ),
        grounds=(Material.PAVING, Material.ASPHALT),
        gap=0.3,
    ),
}
"""Kinds of small vehicles."""
