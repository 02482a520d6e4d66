"""Prompt of the segmenter: a box or points, in pixels; the first pixel spans 0 to 1."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

from vehanchor.errors import PromptError
from vehanchor.options.reading import CoordinateFrame

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from vehanchor.options import Frame
    from vehanchor.options.pixel_grid import PixelGrid
    from vehanchor.options.reading import Place

Box: TypeAlias = tuple[float, float, float, float]
"""x1, y1, x2, y2."""

Point: TypeAlias = tuple[float, float] | tuple[float, float, bool]
"""x, y and, optionally, whether the point is on the object (the default) or outside it."""

LabelledPoint: TypeAlias = tuple[float, float, bool]
"""x, y, and whether the point is on the object."""

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
    points: tuple[LabelledPoint, ...] = ()

    @property
    def extent(self) -> Box:
        """Box, or the smallest one around the points: x1, y1, x2, y2."""
        if self.box is not None:
            return self.box
        xs = [x for x, _, _ in self.points]
        ys = [y for _, y, _ in self.points]
        return min(xs), min(ys), max(xs), max(ys)

    def mapped(self, convert: Callable[[float, float], Place]) -> Prompt:
        """Convert all coordinates with a function of x and y."""
        box = None
        if self.box is not None:
            x1, y1, x2, y2 = self.box
            box = (*convert(x1, y1), *convert(x2, y2))
        points = []
        for x, y, include in self.points:
            points.append((*convert(x, y), include))
        return Prompt(box, tuple(points))


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
    point_list = tuple(points or ())
    if box is None and not point_list:
        raise PromptError("give either a box or points: neither is given")
    if box is not None and point_list:
        raise PromptError("give either a box or points: both are given")
    if box is not None:
        return Prompt(box=_read_box(box))
    return Prompt(points=_read_points(point_list))


def _read_box(box: Any) -> Box:
    values = _plain_box(box)
    numbers = read_numbers(values, (4,), name="box", expected="x1, y1, x2, y2")
    x1, y1, x2, y2 = numbers
    if x2 <= x1 or y2 <= y1:
        raise PromptError(
            f"box is {_numbers_text(numbers)}: it is reversed or empty; x1 < x2 and y1 < y2 are "
            "needed"
        )
    return x1, y1, x2, y2


def _read_points(points: Sequence[Point]) -> tuple[LabelledPoint, ...]:
    read = []
    for point in points:
        x, y, *include = read_numbers(
            point,
            (2, 3),
            name="a point",
            expected="x, y and whether it is on the object, as in points=[(x, y, True)]",
        )
        # A point without the third value is on the object.
        read.append((x, y, all(include)))
    if not any(include for _, _, include in read):
        raise PromptError("no point is on the object: give at least one that is")
    return tuple(read)


def prompt_in_image(prompt: Prompt, frame: Frame, grid: PixelGrid) -> Prompt:
    """Convert a prompt to square pixels of the full image and check it against the image.

    Coordinates that lie outside by less than a pixel of the frame, due to rounding, are clipped.

    Args:
        prompt: prompt in the caller's coordinates.
        frame: size of the caller's copy and unit of its coordinates.
        grid: pixels of the full image.

    Raises:
        PromptError: the prompt is outside the image, or the box is too small.
    """
    coordinates = CoordinateFrame(frame, grid)
    if prompt.box is not None:
        _check_box_inside(prompt.box, coordinates)
    else:
        _check_points_inside(prompt, coordinates)
    converted = prompt.mapped(coordinates.in_image)
    if prompt.box is not None:
        _check_box_size(prompt.box, converted, coordinates)
    return converted


def _check_box_inside(box: Box, coordinates: CoordinateFrame) -> None:
    corners = _corners(box)
    if not coordinates.inside(corners):
        suggestion = coordinates.other_reading(corners) or ": clip it to what is visible"
        raise PromptError(
            f"box {_numbers_text(box)} is not inside the {coordinates.name}{suggestion}"
        )


def _check_box_size(box: Box, converted: Prompt, coordinates: CoordinateFrame) -> None:
    left, top, right, bottom = converted.extent
    width = right - left
    height = bottom - top
    if min(width, height) < MIN_BOX_PX:
        suggestion = coordinates.other_reading(_corners(box))
        raise PromptError(
            f"box {_numbers_text(box)} is {width:.3g} x {height:.3g} px of the full image: at "
            f"least {MIN_BOX_PX:g} px a side are needed{suggestion}"
        )


def _check_points_inside(prompt: Prompt, coordinates: CoordinateFrame) -> None:
    points = [(x, y) for x, y, _ in prompt.points]
    width, height = coordinates.extent
    for x, y in points:
        # A point on the far edge would name a pixel beyond the image.
        if not (0 <= x < width and 0 <= y < height):
            suggestion = coordinates.other_reading(points)
            raise PromptError(
                f"point {x:g}, {y:g} is not inside the {coordinates.name}{suggestion}"
            )


def _corners(box: Box) -> tuple[Place, Place]:
    x1, y1, x2, y2 = box
    return (x1, y1), (x2, y2)


def read_numbers(
    values: Any, counts: tuple[int, ...], *, name: str, expected: str
) -> tuple[float, ...]:
    """Read finite numbers of the caller.

    Args:
        values: the numbers.
        counts: accepted numbers of values.
        name: name of the values, for the message.
        expected: description of valid values, for the message.

    Raises:
        PromptError: the values are not finite numbers, or too few or too many.
    """
    numbers: tuple[float, ...] = ()
    # A string is iterable, but its letters are not coordinates.
    if not isinstance(values, str):
        with contextlib.suppress(TypeError, ValueError):
            numbers = tuple(float(value) for value in values)
    are_finite = all(math.isfinite(number) for number in numbers)
    if len(numbers) not in counts or not are_finite:
        raise PromptError(f"{name} is {values!r}: use {expected}, finite numbers")
    return numbers


def _numbers_text(values: Sequence[float]) -> str:
    return ", ".join(f"{value:g}" for value in values)


def _plain_box(box: Any) -> Any:
    """Return the coordinates of a shapely or supervision object; return other values unchanged.

    Neither library is imported.

    Args:
        box: a geometry of shapely (its ``bounds``), or supervision's ``Detections`` of one object.

    Raises:
        PromptError: the detections are not of exactly one object.
    """
    detected_boxes = getattr(box, "xyxy", None)
    if detected_boxes is None:
        return getattr(box, "bounds", box)
    if len(detected_boxes) != 1:
        raise PromptError(
            f"the detections are of {len(detected_boxes)} objects: give one, such as "
            "detections[i : i + 1]"
        )
    return tuple(float(value) for value in detected_boxes[0])
