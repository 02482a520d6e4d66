"""The option group ``ByHand``: vehicles that the caller drops or adds."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated, Any, ClassVar

from pydantic import BeforeValidator, Field, WithJsonSchema

from vehanchor.errors import InvalidParameterError
from vehanchor.options.option import Limits, Number, Option, group

MOST_BY_HAND = 1000
"""Largest number of vehicles in either list."""

_MOST_CHARS = 4000  # 1000 numbers of three digits with commas
_NUMBER = Limits(1, 1_000_000, whole=True)
_LEAST_LENGTH_PX = 5.0


def in_order(*names: str) -> BeforeValidator:
    """Make a validator that reads the fields of a group from their values in order, or from one text."""

    def read(value: Any) -> Any:
        values = value.replace(",", " ").split() if isinstance(value, str) else value
        if isinstance(values, dict) or not isinstance(values, Iterable):
            return values
        return dict(zip((*names, *map(str, range(64))), values, strict=False))

    return BeforeValidator(read)


@group(frozen=True)
class AddedVehicle:
    """Car that the caller points at: both ends of its long axis.

    Attributes:
        x1: x of one end, pixels of the frame, or of the image without a frame.
        y1: y of that end.
        x2: x of the other end.
        y2: y of that end.
    """

    x1: Number
    y1: Number
    x2: Number
    y2: Number

    @property
    def length_px(self) -> float:
        """Length of the axis in pixels."""
        return math.hypot(self.x2 - self.x1, self.y2 - self.y1)


def vehicle_numbers(value: Any) -> Any:
    """Read numbers of vehicles: a list, or a text with numbers and ranges, as "1-20,23".

    Raises:
        InvalidParameterError: the text is something else, or there are too many numbers.
    """
    if isinstance(value, int) and not isinstance(value, bool):
        value = (value,)
    found = _ranges(value) if isinstance(value, str) else list(value) if isinstance(value, Iterable) else None
    if found is None:
        raise InvalidParameterError(f"drop is {value!r}: give a list of numbers of vehicles, as 1-20,23")
    if len(found) > MOST_BY_HAND:
        raise InvalidParameterError(f"drop has {len(found)} vehicles: give at most {MOST_BY_HAND}")
    return tuple(dict.fromkeys(int(_NUMBER.check("drop", each)) for each in found))


def _ranges(text: str) -> list[int]:
    found: list[int] = []
    for part in text.replace(",", " ").split():
        first, _, last = part.partition("-")
        if not first.isdecimal() or not (last or first).isdecimal() or part.endswith("-"):
            raise InvalidParameterError(f"drop is {text!r}: use numbers and ranges with commas, as 1-20,23")
        low, high = int(first), int(last or first)
        if high < low or high - low >= MOST_BY_HAND:
            raise InvalidParameterError(f"drop has the range {part}: use rising ranges of at most {MOST_BY_HAND}")
        found += range(low, high + 1)
    return found


@group(frozen=True)
class ByHand:
    """Vehicles that the caller drops or adds.

    The numbers are those of the pictures: 1 is the best detection. They hold for one image, one detector and the same
    options of the search.

    Attributes:
        drop: numbers of vehicles that are no cars.
        add: cars that were not found: x1, y1, x2, y2 of the long axis, from bumper to bumper.

    Raises:
        InvalidParameterError: a number or an axis is invalid.
    """

    panel: ClassVar[str] = "Vehicles by hand"

    drop: Annotated[
        tuple[int, ...],
        BeforeValidator(vehicle_numbers),
        WithJsonSchema({"type": "string", "maxLength": _MOST_CHARS}),
        Option("Overlay boxes that are no cars, as 3,7.", metavar="N,N-N", first=True, tools="all"),
    ] = ()
    add: Annotated[
        tuple[Annotated[AddedVehicle, in_order("x1", "y1", "x2", "y2")], ...],
        Field(max_length=MOST_BY_HAND),
        Option(
            "Cars not found: both ends of the long axis.",
            metavar="X1 Y1 X2 Y2",
            repeated=True,
            first=True,
            tools="all",
        ),
    ] = ()

    @property
    def given(self) -> str | None:
        """Name of the first list with vehicles; None without any."""
        return "drop" if self.drop else "add" if self.add else None

    def check_single(self) -> None:
        """Check, before the work on several images, that no vehicle is given.

        Raises:
            InvalidParameterError: one is.
        """
        if self.given:
            raise InvalidParameterError(f"{self.given} belongs to one image: estimate that image by itself")

    def check(self, width_px: int, height_px: int) -> None:
        """Check that all axes are inside the image or frame, and long enough.

        Args:
            width_px: width of the frame, or of the image without a frame.
            height_px: its height.

        Raises:
            InvalidParameterError: an end is outside, or an axis is shorter than five pixels.
        """
        for number, axis in enumerate(self.add, 1):
            inside = all(0 <= x <= width_px for x in (axis.x1, axis.x2))
            if not inside or not all(0 <= y <= height_px for y in (axis.y1, axis.y2)):
                raise InvalidParameterError(
                    f"add {number}, from ({axis.x1:g}, {axis.y1:g}) to ({axis.x2:g}, {axis.y2:g}), leaves the picture "
                    f"of {width_px} x {height_px} px: give both ends in its pixels"
                )
            if axis.length_px < _LEAST_LENGTH_PX:
                raise InvalidParameterError(
                    f"add {number} is {axis.length_px:.1f} px long: give both ends of a car of {_LEAST_LENGTH_PX:g} px "
                    "or more"
                )
