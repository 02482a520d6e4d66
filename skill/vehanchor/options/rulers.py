"""The option group ``Rulers``: rulers to use, and known facts about the scale."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from vehanchor.errors import InvalidParameterError, KnownLengthError
from vehanchor.options.option import Flag, Limits, check_fields, option, set_frozen

_MIN_LINE_PX = 5.0  # on a shorter line, an error of a pixel at each end exceeds a quarter
LINE_LENGTH_M = Limits(above=0, most=100_000)
"""Limits for a line of known length, metres."""

_COORDINATE = Limits()
_HEIGHT_M = Limits(above=0, most=20_000)  # survey aircraft fly at 10 km; cars are too small from higher up
_FOCAL_MM = Limits(above=0, most=10_000)


class KnownLength(NamedTuple):
    """Straight line on the ground with its known length.

    Attributes:
        x1: x of one end, pixels of the frame, or of the image without a frame.
        y1: y of that end.
        x2: x of the other end.
        y2: y of that end.
        metres: length of the line.
    """

    x1: float
    y1: float
    x2: float
    y2: float
    metres: float

    @classmethod
    def from_text(cls, text: str) -> KnownLength:
        """Read a line from five numbers, separated by spaces or commas.

        Raises:
            KnownLengthError: the text is not five numbers.
        """
        try:
            return cls(*(float(part) for part in text.replace(",", " ").split()))
        except (TypeError, ValueError):
            raise KnownLengthError(f"the known length is {text!r}: use five numbers, X1 Y1 X2 Y2 METRES") from None

    @property
    def length_px(self) -> float:
        """Length of the line in pixels."""
        return math.hypot(self.x2 - self.x1, self.y2 - self.y1)


@dataclass(frozen=True)
class Rulers:
    """Rulers to use, and known facts about the scale.

    Attributes:
        rulers: kinds of the rulers to use; None for all. ``vehanchor.records.ruler_kinds`` lists them.
        metadata: use the camera's metadata in the file; False is the paper's case.
        known_lengths: lines of known length: x1, y1, x2, y2 in pixels, and metres.
        height_m: height of the camera above the ground, metres; the view is at nadir unless metadata or courts show a
            tilt.
        focal_35mm: 35 mm equivalent focal length, millimetres; None takes the file's.

    Raises:
        KnownLengthError: a known length is invalid.
        InvalidParameterError: a number is invalid, or the rulers are not a list of names.
    """

    rulers: tuple[str, ...] | None = field(
        default=None,
        metadata=option("Rulers to use, with commas. Default: all.", metavar="NAMES"),
    )
    metadata: bool = field(
        default=True,
        metadata=option("Use the camera's height and focal length if the file has them.", Flag()),
    )
    known_lengths: tuple[KnownLength, ...] = field(
        default=(),
        metadata=option(
            "Lines of known length on the ground.",
            metavar="X1 Y1 X2 Y2 METRES",
            flag="known-length",
        ),
    )
    height_m: float | None = field(
        default=None,
        metadata=option(
            "Camera height above ground, metres, for a nadir view or a known tilt.",
            _HEIGHT_M,
            metavar="M",
        ),
    )
    focal_35mm: float | None = field(
        default=None,
        metadata=option(
            "With the height: 35 mm equivalent focal length, mm. Default: the file's.", _FOCAL_MM, metavar="MM"
        ),
    )

    def __post_init__(self) -> None:
        if self.rulers is not None:
            set_frozen(self, "rulers", _ruler_names(self.rulers))
        set_frozen(self, "known_lengths", _lines(self.known_lengths))
        if self.focal_35mm is not None and self.height_m is None:
            raise InvalidParameterError("focal_35mm needs height_m: also give the height above the ground")
        check_fields(self)

    def check_lengths(self) -> None:
        """Check that no line is too short.

        Raises:
            KnownLengthError: a line is shorter than five pixels.
        """
        for line in self.known_lengths:
            if line.length_px < _MIN_LINE_PX:
                raise KnownLengthError(
                    f"the line of known length is {line.length_px:.1f} px long: use one of {_MIN_LINE_PX:g} px or more"
                )

    def check(self, width_px: int, height_px: int) -> None:
        """Check that all lines are inside the image or frame, and long enough.

        Args:
            width_px: width of the frame, or of the image without a frame.
            height_px: its height.

        Raises:
            KnownLengthError: an end is outside, or a line is shorter than five pixels.
        """
        self.check_lengths()
        for line in self.known_lengths:
            if not all(0 <= x <= width_px for x in (line.x1, line.x2)) or not all(
                0 <= y <= height_px for y in (line.y1, line.y2)
            ):
                raise KnownLengthError(
                    f"the line from ({line.x1:g}, {line.y1:g}) to ({line.x2:g}, {line.y2:g}) leaves the picture of "
                    f"{width_px} x {height_px} px: give both ends in its pixels"
                )


def _ruler_names(names: Any) -> tuple[str, ...]:
    if isinstance(names, str) or not isinstance(names, Collection) or not all(isinstance(name, str) for name in names):
        raise InvalidParameterError(f"rulers is {names!r}: give a list of names")
    if not names:
        raise InvalidParameterError(f"rulers is {names!r}: name at least one, or leave it out")
    return tuple(dict.fromkeys(names))


def _lines(lines: Any) -> tuple[KnownLength, ...]:
    if isinstance(lines, str) or not isinstance(lines, Iterable):
        raise KnownLengthError(f"known_lengths is {lines!r}: give lines of x1, y1, x2, y2, metres")
    checked = []
    for line in lines:
        try:
            x1, y1, x2, y2, metres = (_COORDINATE.check("known_lengths", each) for each in line)
            LINE_LENGTH_M.check("the line's length in metres", metres)
        except (TypeError, ValueError) as error:
            raise KnownLengthError(f"the known length {line!r} is not x1, y1, x2, y2, metres: {error}") from None
        checked.append(KnownLength(x1, y1, x2, y2, metres))
    return tuple(checked)
