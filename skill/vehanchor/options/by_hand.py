"""The option group ``ByHand``: vehicles that the caller drops or adds."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple

from vehanchor.errors import InvalidParameterError
from vehanchor.options.option import Limits, option, set_frozen

BY_HAND = ("drop", "add")
"""Names of the options, which belong to one image."""

MOST_BY_HAND = 1000
"""Largest number of vehicles in each of the two lists."""

_NUMBER = Limits(1, 1_000_000, whole=True)
_COORDINATE = Limits()
_LEAST_LENGTH_PX = 5.0


class AddedVehicle(NamedTuple):
    """Car that the caller points at: both ends of its long axis.

    Attributes:
        x1: x of one end, pixels of the frame, or of the image without a frame.
        y1: y of that end.
        x2: x of the other end.
        y2: y of that end.
    """

    x1: float
    y1: float
    x2: float
    y2: float

    @property
    def length_px(self) -> float:
        """Length of the axis in pixels."""
        return math.hypot(self.x2 - self.x1, self.y2 - self.y1)


@dataclass(frozen=True)
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

    drop: tuple[int, ...] = field(
        default=(),
        metadata=option(
            "Overlay boxes that are no cars, as 3,7.", metavar="N,N-N", read=lambda text: vehicle_numbers("drop", text)
        ),
    )
    add: tuple[AddedVehicle, ...] = field(
        default=(),
        metadata=option(
            "Cars not found: both ends of the long axis.",
            metavar="X1 Y1 X2 Y2",
            read=lambda text: axis_of_text(text),
            repeated=True,
        ),
    )

    def __post_init__(self) -> None:
        set_frozen(self, "drop", _numbers("drop", self.drop))
        set_frozen(self, "add", _axes(self.add))

    @property
    def given(self) -> str | None:
        """Name of the first list with vehicles; None without any."""
        return next((each for each in BY_HAND if getattr(self, each)), None)

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
            if not all(0 <= x <= width_px for x in axis[::2]) or not all(0 <= y <= height_px for y in axis[1::2]):
                raise InvalidParameterError(
                    f"add {number}, from ({axis.x1:g}, {axis.y1:g}) to ({axis.x2:g}, {axis.y2:g}), leaves the picture "
                    f"of {width_px} x {height_px} px: give both ends in its pixels"
                )
            if axis.length_px < _LEAST_LENGTH_PX:
                raise InvalidParameterError(
                    f"add {number} is {axis.length_px:.1f} px long: give both ends of a car of {_LEAST_LENGTH_PX:g} px "
                    "or more"
                )


def vehicle_numbers(name: str, text: str) -> tuple[int, ...]:
    """Read numbers and ranges with commas, as "1-20,23".

    Args:
        name: of the option, for messages.
        text: the numbers; empty for none.

    Raises:
        InvalidParameterError: the text is something else, or has too many numbers.
    """
    found: list[int] = []
    for part in filter(None, text.replace(",", " ").split()):
        first, _, last = part.partition("-")
        if not first.isdecimal() or not (last or first).isdecimal() or part.endswith("-"):
            raise InvalidParameterError(f"{name} is {text!r}: use numbers and ranges with commas, as 1-20,23")
        low, high = int(first), int(last or first)
        if high < low or high - low >= MOST_BY_HAND:
            raise InvalidParameterError(f"{name} has the range {part}: use rising ranges of at most {MOST_BY_HAND}")
        found += range(low, high + 1)
    return tuple(found)


def axis_of_text(text: str) -> AddedVehicle:
    """Read an axis, ``X1 Y1 X2 Y2``; commas are spaces.

    Raises:
        InvalidParameterError: the text is not four numbers.
    """
    try:
        return AddedVehicle(*map(float, text.replace(",", " ").split()))
    except (TypeError, ValueError):
        raise InvalidParameterError(f"add is {text!r}: use four numbers, X1 Y1 X2 Y2") from None


def _numbers(name: str, values: Any) -> tuple[int, ...]:
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise InvalidParameterError(f"{name} is {values!r}: give a list of numbers of vehicles")
    numbers = tuple(dict.fromkeys(int(_NUMBER.check(name, each)) for each in values))
    _check_count(name, numbers)
    return numbers


def _axes(values: Any) -> tuple[AddedVehicle, ...]:
    message = f"add is {values!r}: give axes of x1, y1, x2, y2"
    if isinstance(values, str) or not isinstance(values, Iterable):
        raise InvalidParameterError(message)
    try:
        axes = tuple(AddedVehicle(*(_COORDINATE.check("add", each) for each in axis)) for axis in values)
    except TypeError:
        raise InvalidParameterError(message) from None
    _check_count("add", axes)
    return axes


def _check_count(name: str, values: tuple[Any, ...]) -> None:
    if len(values) > MOST_BY_HAND:
        raise InvalidParameterError(f"{name} has {len(values)} vehicles: give at most {MOST_BY_HAND}")
