"""Prompt of the segmenter: a box or points, in pixels; the first pixel spans 0 to 1."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

from vehanchor.errors import PromptError
from vehanchor.options.reading import CoordinateFrame

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from vehanchor.options import Frame
    from vehanchor.options.reading import Place

Box: TypeAlias = tuple[float, float, float, float]
"""x1, y1, x2, y2."""

Point: TypeAlias = tuple[float, float] | tuple[float, float, bool]
"""x, y and, optionally, whether the point is on the object (the default) or outside it."""

MIN_BOX_PX = 2.0
"""Smallest side of a box, pixels of the full image."""


@dataclass(frozen=True)
class Prompt:
    """Box or points that name the object, in pixels; the first pixel spans 0 to 1.

    Attributes:
        box: x1, y1, x2, y2.
        points: x, y, and whether the point is on the object.
    """

    box: Box | None = None
    points: tuple[tuple[float, float, bool], ...] = ()

    @property
    def extent(self) -> Box:
        """Box, or the smallest one around the points: x1, y1, x2, y2."""
        if self.box is not None:
            return self.box
        xs = [x for x, _, _ in self.points]
        ys = [y for _, y, _ in self.points]
        return min(xs), min(ys), max(xs), max(ys)

    def mapped(self, place: Callable[[float, float], Place]) -> Prompt:
        """Convert all coordinates."""
        box = self.box and (*place(*self.box[:2]), *place(*self.box[2:]))
        return Prompt(box, tuple((*place(x, y), include) for x, y, include in self.points))


def read_prompt(box: Box | None, points: Sequence[Point] | None) -> Prompt:
    """Read the caller's prompt and check it without an image.

    Args:
        box: box around the object, also as a shapely geometry or a supervision detection; None with
            points.
        points: points, at least one on the object; None with a box.

    Raises:
        PromptError: neither or both are given, or the prompt is invalid for every image.
    """
    if isinstance(points, str) or not isinstance(points, Iterable | None):
        raise PromptError(f"points is {points!r}: use one or more of x, y")
    given = tuple(points or ())
    if (box is None) == (not given):
        found = "neither is given" if box is None else "both are given"
        raise PromptError(f"give a box or points, one of the two: {found}")
    if box is not None:
        x1, y1, x2, y2 = read_numbers(_as_box(box), (4,), name="box", wanted="x1, y1, x2, y2")
        if x2 <= x1 or y2 <= y1:
            raise PromptError(
                f"box is {_numbers((x1, y1, x2, y2))}: x1 < x2 and y1 < y2 are needed, it is "
                "reversed or empty"
            )
        return Prompt(box=(x1, y1, x2, y2))
    read = []
    for each in given:
        x, y, *include = read_numbers(
            each, (2, 3), name="a point", wanted="x, y and whether it is on the object"
        )
        read.append((x, y, all(include)))
    if not any(include for _, _, include in read):
        raise PromptError("no point is on the object: give at least one that is")
    return Prompt(points=tuple(read))


def prompt_in_image(given: Prompt, frame: Frame, width_px: int, height_px: int) -> Prompt:
    """Convert a prompt to pixels of the full image and check it against the image.

    Coordinates that lie outside by less than a pixel of the frame, due to rounding, are clipped.

    Args:
        given: prompt in the caller's coordinates.
        frame: size of the caller's copy and unit of its coordinates.
        width_px: width of the full image.
        height_px: height of the full image.

    Raises:
        PromptError: the prompt is outside the image, or the box is too small.
    """
    coordinates = CoordinateFrame(frame, width_px, height_px)
    if given.box is not None:
        x1, y1, x2, y2 = given.box
        ends = ((x1, y1), (x2, y2))
        if not coordinates.inside(ends):
            meant = coordinates.other_reading(ends) or ": clip it to what is visible"
            raise PromptError(
                f"box {_numbers(given.box)} is not inside the {coordinates.name}{meant}"
            )
        prompt = given.mapped(coordinates.in_image)
        left, top, right, bottom = prompt.extent
        if min(right - left, bottom - top) < MIN_BOX_PX:
            raise PromptError(
                f"box {_numbers(given.box)} is {right - left:.3g} x {bottom - top:.3g} px of "
                "the full image: at "
                f"least {MIN_BOX_PX:g} px a side are needed{coordinates.other_reading(ends)}"
            )
        return prompt
    places = [(x, y) for x, y, _ in given.points]
    for x, y in places:
        if not (0 <= x < coordinates.extent[0] and 0 <= y < coordinates.extent[1]):
            raise PromptError(
                f"point {x:g}, {y:g} is not inside the "
                f"{coordinates.name}{coordinates.other_reading(places)}"
            )
    return given.mapped(coordinates.in_image)


def read_numbers(values: Any, counts: tuple[int, ...], name: str, wanted: str) -> tuple[float, ...]:
    """Read finite numbers of the caller.

    Args:
        values: the numbers.
        counts: how many they may be.
        name: what they are, for the message.
        wanted: what they should be, for the message.

    Raises:
        PromptError: they are something else.
    """
    try:
        numbers = () if isinstance(values, str) else tuple(map(float, values))
    except (TypeError, ValueError):
        numbers = ()
    if len(numbers) not in counts or not all(map(math.isfinite, numbers)):
        raise PromptError(f"{name} is {values!r}: use {wanted}, finite numbers")
    return numbers


def _numbers(values: Sequence[float]) -> str:
    return ", ".join(f"{value:g}" for value in values)


def _as_box(box: Any) -> Any:
    """Take the box of a shapely or supervision object, without importing either; return other values unchanged.

    Args:
        box: a geometry of shapely (its ``bounds``), or supervision's ``Detections`` of one object.

    Raises:
        PromptError: the detections are not of exactly one object.
    """
    found = getattr(box, "xyxy", None)
    if found is not None:
        if len(found) != 1:
            raise PromptError(
                f"the detections are of {len(found)} objects: give one, as detections[i : i + 1]"
            )
        return tuple(float(value) for value in found[0])
    return getattr(box, "bounds", box)
