"""Things that a detector may take for cars: graves, bales, boats, carts, containers and others."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from research.scenes.site import Site, jitter, pick
from research.scenes.world import Box, Material, Rgb

if TYPE_CHECKING:
    from research.scenes.world import Points

WHITE: Rgb = (232, 231, 226)
STONE: Rgb = (168, 166, 160)
DARK: Rgb = (62, 64, 68)

Shape = tuple[tuple[float, float], ...]
"""Corners in shares of the length and of the width; the thing spans -0.5 to 0.5."""


class Part(NamedTuple):
    """Part of a thing, as seen from above.

    Attributes:
        shape: outline.
        gain: brightness relative to the thing's paint.
        rgb: own colour; None for the paint.
    """

    shape: Shape
    gain: float = 1.0
    rgb: Rgb | None = None


class Thing(NamedTuple):
    """Kind of thing.

    Attributes:
        lengths_m: shortest and longest; one scene has a single model.
        width_per_length: narrowest and widest.
        height_m: height, for the shadow.
        paints: colours.
        parts: parts, from the ground up; the first one casts the shadow.
        grounds: materials on which it stands.
        gap: least distance between neighbours, in widths.
        one_paint: whether all things of a scene have the same paint.
        pixels: range of the length in pixels.
    """

    lengths_m: tuple[float, float]
    width_per_length: tuple[float, float]
    height_m: float
    paints: tuple[Rgb, ...]
    parts: tuple[Part, ...]
    grounds: tuple[Material, ...]
    gap: float = 0.6
    one_paint: bool = True
    pixels: tuple[float, float] = (16.0, 60.0)


def rectangle(x0: float, y0: float, x1: float, y1: float) -> Shape:
    """Build a rectangle from two corners."""
    return ((x0, y0), (x1, y0), (x1, y1), (x0, y1))


def _cylinder(strips: int = 9) -> tuple[Part, ...]:
    """Build a lying cylinder of strips that the sun lights from one side."""
    parts = [Part(rectangle(-0.5, -0.5, 0.5, 0.5))]
    edges = np.linspace(-0.5, 0.5, strips + 1)
    for low, high in zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        slope = low + high
        gain = 0.62 + 0.5 * math.sqrt(max(0.0, 1.0 - slope**2)) - 0.18 * slope
        parts.append(Part(rectangle(-0.5, low, 0.5, high), gain))
    return tuple(parts)


def slats(count: int, gain: float) -> tuple[Part, ...]:
    """Build dark joints across the whole thing."""
    joints = []
    for x in np.linspace(-0.5, 0.5, count + 1).tolist():
        joints.append(Part(rectangle(x - 0.02, -0.5, x + 0.02, 0.5), gain))
    return tuple(joints)


def gable() -> tuple[Part, ...]:
    """Build a ridge along the length, with a light and a dark side."""
    whole = Part(rectangle(-0.5, -0.5, 0.5, 0.5))
    light = Part(rectangle(-0.5, -0.5, 0.5, 0.0), 1.05)
    dark = Part(rectangle(-0.5, 0.0, 0.5, 0.5), 0.78)
    return (whole, light, dark)


WHOLE = Part(rectangle(-0.5, -0.5, 0.5, 0.5))
HULL: Shape = (
    (-0.5, -0.42), (0.1, -0.5), (0.32, -0.36), (0.5, 0.0), (0.32, 0.36), (0.1, 0.5), (-0.5, 0.42),
)  # fmt: skip
_DECK: Shape = (
    (-0.46, -0.32), (0.1, -0.38), (0.3, -0.26), (0.42, 0.0), (0.3, 0.26), (0.1, 0.38),
    (-0.46, 0.32),
)  # fmt: skip

_EGG: Shape = (
    (-0.4, -0.5), (0.3, -0.5), (0.46, -0.3), (0.5, 0.0), (0.46, 0.3), (0.3, 0.5), (-0.4, 0.5),
    (-0.5, 0.3), (-0.5, -0.3),
)  # fmt: skip
_EGG_BODY: Shape = (
    (-0.36, -0.4), (0.26, -0.4), (0.4, -0.24), (0.43, 0.0), (0.4, 0.24), (0.26, 0.4),
    (-0.36, 0.4), (-0.43, 0.24), (-0.43, -0.24),
)  # fmt: skip

GREEN = (Material.LAWN, Material.MEADOW)
HARD = (Material.ASPHALT, Material.PAVING, Material.GRAVEL)
_FIELD = (Material.MEADOW, Material.CROP, Material.SOIL)

THINGS: dict[str, Thing] = {
    "gravestones": Thing(
        lengths_m=(0.55, 0.9),
        width_per_length=(0.4, 0.6),
        height_m=0.8,
        paints=(WHITE, WHITE, STONE),
        parts=(WHOLE,),
        grounds=GREEN,
        gap=2.0,
        pixels=(14.0, 36.0),
    ),
    "graves": Thing(
        lengths_m=(1.8, 2.2),
        width_per_length=(0.4, 0.5),
        height_m=0.3,
        paints=(STONE, (120, 116, 112), DARK, WHITE),
        parts=(
            WHOLE,
            Part(rectangle(-0.38, -0.36, 0.46, 0.36), 0.72),
            Part(rectangle(-0.5, -0.4, -0.4, 0.4), 1.2),
        ),
        grounds=(*GREEN, Material.GRAVEL),
        gap=0.5,
        one_paint=False,
    ),
    "round bales": Thing(
        lengths_m=(1.2, 1.6),
        width_per_length=(0.85, 1.0),
        height_m=1.3,
        paints=((190, 170, 118), (206, 188, 140), (225, 225, 220)),
        parts=_cylinder(),
        grounds=_FIELD,
        gap=2.5,
    ),
    "square bales": Thing(
        lengths_m=(2.2, 2.5),
        width_per_length=(0.45, 0.52),
        height_m=0.9,
        paints=((196, 176, 122), (206, 190, 146)),
        parts=(WHOLE, *slats(5, 0.88)),
        grounds=_FIELD,
        gap=1.5,
    ),
    "pipes": Thing(
        lengths_m=(2.0, 3.2),
        width_per_length=(0.35, 0.55),
        height_m=1.2,
        paints=((176, 174, 168), (150, 150, 148)),
        parts=_cylinder(),
        grounds=(Material.GRAVEL, Material.SOIL, Material.MEADOW),
        gap=0.15,
    ),
    "boats": Thing(
        lengths_m=(4.5, 9.0),
        width_per_length=(0.3, 0.38),
        height_m=1.2,
        paints=(WHITE, WHITE, (60, 84, 120)),
        parts=(
            Part(HULL),
            Part(_DECK, 0.9),
            Part(rectangle(-0.42, -0.26, -0.1, 0.26), 0.5),
            Part(rectangle(-0.02, -0.22, 0.14, 0.22), rgb=(70, 82, 94)),
        ),
        grounds=(Material.WATER, Material.GRAVEL, Material.ASPHALT),
        gap=0.35,
        one_paint=False,
    ),
    "trailers": Thing(
        lengths_m=(2.4, 4.2),
        width_per_length=(0.42, 0.55),
        height_m=1.0,
        paints=(DARK, (150, 150, 150), (70, 96, 140)),
        parts=(
            Part(rectangle(-0.5, -0.5, 0.3, 0.5)),
            Part(rectangle(-0.45, -0.42, 0.26, 0.42), 0.7),
            Part(((0.3, -0.12), (0.5, 0.0), (0.3, 0.12)), 0.6),
        ),
        grounds=HARD,
        gap=0.4,
    ),
    "caravans": Thing(
        lengths_m=(5.6, 7.4),
        width_per_length=(0.32, 0.4),
        height_m=2.3,
        paints=(WHITE,),
        parts=(
            Part(rectangle(-0.5, -0.5, 0.38, 0.5)),
            Part(rectangle(-0.2, -0.15, -0.1, 0.15), 0.8),
            Part(rectangle(0.1, -0.15, 0.2, 0.15), 0.8),
            Part(rectangle(0.38, -0.04, 0.5, 0.04), 0.5),
        ),
        grounds=(*HARD, Material.LAWN),
        gap=0.5,
    ),
    "containers": Thing(
        lengths_m=(6.06, 6.06),
        width_per_length=(0.4, 0.405),
        height_m=2.6,
        paints=((150, 62, 44), (60, 86, 128), (176, 174, 166)),
        parts=(WHOLE, *slats(12, 0.9)),
        grounds=HARD,
        gap=0.15,
        one_paint=False,
    ),
    "long containers": Thing(
        lengths_m=(12.19, 12.19),
        width_per_length=(0.2, 0.202),
        height_m=2.6,
        paints=((150, 62, 44), (60, 86, 128), (190, 140, 60)),
        parts=(WHOLE, *slats(20, 0.9)),
        grounds=HARD,
        gap=0.2,
        one_paint=False,
    ),
    "tents": Thing(
        lengths_m=(2.2, 4.5),
        width_per_length=(0.5, 0.8),
        height_m=1.6,
        paints=((120, 140, 90), (200, 120, 60), WHITE, (80, 110, 150)),
        parts=gable(),
        grounds=GREEN,
        gap=0.8,
        one_paint=False,
    ),
    "tables": Thing(
        lengths_m=(1.8, 2.4),
        width_per_length=(0.7, 0.85),
        height_m=0.75,
        paints=((168, 132, 92), (196, 176, 146), (140, 140, 138)),
        parts=(
            Part(rectangle(-0.5, -0.22, 0.5, 0.22)),
            Part(rectangle(-0.48, -0.5, 0.48, -0.34), 0.9),
            Part(rectangle(-0.48, 0.34, 0.48, 0.5), 0.9),
            *slats(1, 0.95),
        ),
        grounds=(*GREEN, Material.PAVING),
        gap=0.8,
    ),
    "golf carts": Thing(
        lengths_m=(2.3, 2.7),
        width_per_length=(0.45, 0.5),
        height_m=1.8,
        paints=(WHITE, (210, 200, 180), (110, 130, 110)),
        parts=(
            WHOLE,
            Part(rectangle(-0.22, -0.44, 0.3, 0.44), 1.1),
            Part(rectangle(0.3, -0.4, 0.36, 0.4), rgb=(60, 66, 72)),
            Part(rectangle(-0.48, -0.36, -0.28, 0.36), 0.5),
        ),
        grounds=(Material.ASPHALT, Material.PAVING, Material.LAWN),
        gap=0.4,
    ),
    "apron tugs": Thing(
        lengths_m=(2.8, 4.0),
        width_per_length=(0.48, 0.6),
        height_m=1.4,
        paints=(WHITE, (210, 180, 60), (120, 130, 140)),
        parts=(
            WHOLE,
            Part(rectangle(-0.1, -0.4, 0.16, 0.4), 0.5),
            Part(rectangle(0.2, -0.44, 0.48, 0.44), 1.1),
        ),
        grounds=(Material.PAVING,),
        gap=0.7,
    ),
    "dollies": Thing(
        lengths_m=(3.2, 3.6),
        width_per_length=(0.48, 0.55),
        height_m=0.6,
        paints=((150, 154, 158), (176, 176, 172)),
        parts=(WHOLE, Part(rectangle(-0.42, -0.4, 0.42, 0.4), 0.75), *slats(3, 0.6)),
        grounds=(Material.PAVING, Material.ASPHALT),
        gap=0.3,
    ),
    "bins": Thing(
        lengths_m=(1.2, 1.5),
        width_per_length=(0.7, 0.85),
        height_m=1.2,
        paints=((60, 90, 60), (50, 70, 120), DARK, (190, 170, 50)),
        parts=(
            WHOLE,
            Part(rectangle(-0.45, -0.1, 0.45, 0.5), 1.15),
            Part(rectangle(-0.45, -0.4, 0.45, -0.2), 0.8),
        ),
        grounds=HARD,
        gap=0.2,
    ),
    "skips": Thing(
        lengths_m=(3.2, 4.0),
        width_per_length=(0.45, 0.55),
        height_m=1.3,
        paints=((180, 140, 40), (60, 90, 130), (120, 120, 118)),
        parts=(WHOLE, Part(rectangle(-0.44, -0.4, 0.44, 0.4), 0.45)),
        grounds=HARD,
        gap=0.4,
    ),
    "greenhouses": Thing(
        lengths_m=(6.0, 30.0),
        width_per_length=(0.28, 0.4),
        height_m=2.8,
        paints=((206, 212, 212), (188, 198, 200)),
        parts=(*gable(), *slats(10, 0.85)),
        grounds=_FIELD,
        gap=0.25,
    ),
    "solar panels": Thing(
        lengths_m=(1.65, 2.1),
        width_per_length=(0.48, 0.62),
        height_m=0.3,
        paints=((38, 46, 74), (28, 32, 44)),
        parts=(WHOLE, *slats(4, 1.5), Part(rectangle(-0.5, -0.02, 0.5, 0.02), 1.5)),
        grounds=(*GREEN, Material.GRAVEL),
        gap=0.15,
    ),
    "pallets": Thing(
        lengths_m=(1.2, 1.2),
        width_per_length=(0.66, 0.84),
        height_m=0.8,
        paints=((190, 160, 116), (170, 140, 104), WHITE),
        parts=(WHOLE, *slats(6, 0.75)),
        grounds=HARD,
        gap=0.3,
    ),
    "sheds": Thing(
        lengths_m=(2.2, 3.5),
        width_per_length=(0.55, 0.9),
        height_m=2.2,
        paints=((128, 112, 96), (104, 106, 110), (172, 120, 96)),
        parts=gable(),
        grounds=GREEN,
        gap=1.5,
        one_paint=False,
    ),
    "sunbeds": Thing(
        lengths_m=(1.9, 2.0),
        width_per_length=(0.33, 0.4),
        height_m=0.4,
        paints=(WHITE, (70, 120, 170), (220, 200, 150)),
        parts=(WHOLE, Part(rectangle(0.2, -0.45, 0.48, 0.45), 0.85)),
        grounds=(Material.SOIL, Material.PAVING, Material.LAWN),
        gap=0.8,
    ),
    "bumper cars": Thing(
        lengths_m=(1.7, 2.0),
        width_per_length=(0.58, 0.68),
        height_m=0.9,
        paints=((150, 32, 34), (48, 70, 118), (205, 140, 40), DARK),
        parts=(
            Part(_EGG, rgb=DARK),
            Part(_EGG_BODY),
            Part(rectangle(-0.2, -0.24, 0.1, 0.24), rgb=(30, 30, 32)),
            Part(rectangle(-0.36, -0.28, -0.2, 0.28), 1.15),
        ),
        grounds=(Material.PAVING, Material.ASPHALT),
        gap=0.6,
        one_paint=False,
    ),
    "forklifts": Thing(
        lengths_m=(2.2, 2.9),
        width_per_length=(0.42, 0.5),
        height_m=2.1,
        paints=((215, 165, 40), (180, 60, 40), (120, 124, 128)),
        parts=(
            Part(rectangle(-0.5, -0.5, 0.2, 0.5)),
            Part(rectangle(-0.2, -0.42, 0.16, 0.42), rgb=(44, 46, 50)),
            Part(rectangle(-0.46, -0.4, -0.26, 0.4), 0.8),
            Part(rectangle(0.2, -0.3, 0.5, -0.18), rgb=(50, 50, 52)),
            Part(rectangle(0.2, 0.18, 0.5, 0.3), rgb=(50, 50, 52)),
        ),
        grounds=HARD,
        gap=0.5,
    ),
    "covered boats": Thing(
        lengths_m=(3.2, 6.0),
        width_per_length=(0.36, 0.46),
        height_m=1.1,
        paints=((60, 84, 120), (90, 96, 100), (120, 130, 110), WHITE),
        parts=(
            Part(HULL, 0.8),
            Part(_DECK),
            Part(((-0.4, -0.05), (0.35, 0.0), (-0.4, 0.05)), 1.2),
            Part(((-0.4, 0.05), (0.35, 0.0), (-0.4, 0.3)), 0.75),
        ),
        grounds=(Material.WATER, Material.GRAVEL, Material.MEADOW),
        gap=0.4,
        one_paint=False,
    ),
    "roof units": Thing(
        lengths_m=(1.8, 3.2),
        width_per_length=(0.45, 0.7),
        height_m=1.2,
        paints=((196, 198, 200), (170, 172, 174)),
        parts=(
            WHOLE,
            Part(rectangle(-0.4, -0.34, -0.02, 0.34), 0.6),
            Part(rectangle(0.04, -0.34, 0.42, 0.34), 0.6),
        ),
        grounds=(Material.GRAVEL, Material.PLAIN),
        gap=1.0,
    ),
}


class Model(NamedTuple):
    """One model of a thing, of which a scene has many.

    Attributes:
        thing: its kind.
        length_m: length.
        width_m: width.
        paint: paint of all of them, if they have the same.
        marks: stripes across all of them, such as straps, lids, windows or inscriptions.
    """

    thing: Thing
    length_m: float
    width_m: float
    paint: Rgb
    marks: tuple[Part, ...]


def draw_model(thing: Thing, rng: np.random.Generator) -> Model:
    """Draw the size and the paint of one model."""
    length_m = float(rng.uniform(*thing.lengths_m))
    width_m = length_m * float(rng.uniform(*thing.width_per_length))
    paint = pick(rng, thing.paints)
    return Model(thing, length_m, width_m=width_m, paint=paint, marks=_draw_marks(rng))


def _draw_marks(rng: np.random.Generator) -> tuple[Part, ...]:
    """Draw no, one or two stripes across, mostly dark."""
    marks = []
    for _ in range(rng.integers(0, 3)):
        middle = rng.uniform(-0.35, 0.35)
        half = rng.uniform(0.02, 0.1)
        across = rng.uniform(0.25, 0.45)
        stripe = rectangle(middle - half, -across, middle + half, across)
        marks.append(Part(stripe, rng.uniform(0.3, 1.15)))
    return tuple(marks)


def place(site: Site, model: Model, x: float, y: float, *, angle: float) -> None:
    """Add one thing of a model, with its centre at (x, y) and its length along ``angle``."""
    rng = site.rng
    paint = model.paint if model.thing.one_paint else pick(rng, model.thing.paints)
    paint = jitter(rng, paint, 5, 0.04)
    frame = site.frame.at(x, y, angle)
    for index, part in enumerate((*model.thing.parts, *model.marks)):
        height_m = model.thing.height_m if index == 0 else 0.0
        outline = _outline(part.shape, model)
        colour = part.rgb or _lit(paint, part.gain)
        site.world.boxes.append(Box(frame.points(outline), height_m, colour))


def _outline(shape: Shape, model: Model) -> Points:
    return np.array(shape) * (model.length_m, model.width_m)


def _lit(rgb: Rgb, gain: float) -> Rgb:
    red, green, blue = (int(min(max(channel * gain, 5), 250)) for channel in rgb)
    return red, green, blue
