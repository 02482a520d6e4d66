"""The option group ``Rulers``: rulers to use, and known facts about the scale."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, NamedTuple, TypeAlias, get_args

from vehanchor.errors import InvalidParameterError, KnownLengthError
from vehanchor.options.given_scale import GSD_M_PER_PX
from vehanchor.options.option import Flag, Limits, Text, Words, check_fields, option, set_frozen

Basis: TypeAlias = Literal["assumed", "measured"]
"""How a fact is known: by a standard or an inference, or by tape, plan or survey."""

_BASES = Words(get_args(Basis))
_NAME = Text(64)
_STATED_TOLERANCE = 0.1  # half of the 95 % interval of a stated scale without a tolerance, relative; a choice
_MIN_LINE_PX = 5.0  # on a shorter line, an error of a pixel at each end exceeds a quarter
LINE_LENGTH_M = Limits(above=0, most=100_000)
"""Limits for a line of known length, metres."""

_COORDINATE = Limits()
_HEIGHT_M = Limits(above=0, most=20_000)  # survey aircraft fly at 10 km; cars are too small from higher up
_FOCAL_MM = Limits(above=0, most=10_000)


class StatedScale(NamedTuple):
    """Scale from elsewhere, as of a map or a sister photograph.

    Attributes:
        gsd_m_per_px: metres per pixel of the full image.
        basis: how it is known.
        tolerance: half of its 95 % interval, metres per pixel.
    """

    gsd_m_per_px: float
    basis: Basis
    tolerance: float

    @classmethod
    def of(cls, gsd_m_per_px: float, basis: Basis = "assumed", tolerance: float | None = None) -> StatedScale:
        """Check a stated scale; without a tolerance, 10 % are taken.

        Raises:
            InvalidParameterError: a number is invalid, or the tolerance reaches the scale.
        """
        gsd = GSD_M_PER_PX.check("gsd_m_per_px", gsd_m_per_px)
        half = _STATED_TOLERANCE * gsd if tolerance is None else GSD_M_PER_PX.check("gsd_tolerance", tolerance)
        if half >= gsd:
            raise InvalidParameterError(
                f"gsd_tolerance is {half:g}, as large as the scale: give half of its 95 % interval"
            )
        _BASES.check("gsd_basis", basis)
        return cls(gsd, basis, half)


class KnownLength(NamedTuple):
    """Straight line on the ground with its known length.

    Attributes:
        x1: x of one end, pixels of the frame, or of the image without a frame.
        y1: y of that end.
        x2: x of the other end.
        y2: y of that end.
        metres: length of the line; None for a thing of known size.
        basis: how the length is known: assumed, or measured by tape, plan or survey.
        tolerance_m: half of the 95 % interval of the length, metres; None for the default of its basis.
        what: thing of known size by its name in ``vehanchor.rulers.standards``, with an optional country, as
            "railway_gauge/ES"; None for a length in metres.
    """

    x1: float
    y1: float
    x2: float
    y2: float
    metres: float | None
    basis: Basis = "assumed"
    tolerance_m: float | None = None
    what: str | None = None

    @classmethod
    def of(cls, values: Iterable[Any]) -> KnownLength:
        """Check the values of a line, in their order; a name in the place of the metres is a thing of known size.

        Raises:
            KnownLengthError: a value is missing or invalid.
        """
        given = tuple(values)
        try:
            told = cls(*given)
            ends = [_COORDINATE.check("known_lengths", each) for each in told[:4]]
            what = told.metres if isinstance(told.metres, str) else told.what
            metres = None
            if what is None:
                metres = LINE_LENGTH_M.check("the line's length in metres", told.metres)
            else:
                _NAME.check("the thing of known size", what)
                if isinstance(told.metres, float | int) or told.basis == "measured" or told.tolerance_m is not None:
                    raise KnownLengthError(f"a thing of known size, {what!r}, has no metres, basis or tolerance")
            _BASES.check("the line's basis", told.basis)
            tolerance = told.tolerance_m
            if tolerance is not None:
                tolerance = LINE_LENGTH_M.check("the line's tolerance in metres", tolerance)
        except (TypeError, ValueError) as error:
            raise KnownLengthError(f"the known length {given!r} is not x1, y1, x2, y2, metres: {error}") from None
        x1, y1, x2, y2 = ends
        return cls(x1, y1, x2, y2, metres, told.basis, tolerance, what)

    @classmethod
    def from_text(cls, text: str) -> KnownLength:
        """Read a line, ``X1 Y1 X2 Y2 METRES[+-TOLERANCE] [measured]`` or ``X1 Y1 X2 Y2 NAME``; commas are spaces.

        Raises:
            KnownLengthError: the text is no line.
        """
        parts = text.replace(",", " ").split()
        basis = parts.pop() if parts and parts[-1] in get_args(Basis) else "assumed"
        try:
            *ends, length = parts
            x1, y1, x2, y2 = map(float, ends)
            metres, _, tolerance = length.partition("+-")
            values = (number_or_name(metres), basis, float(tolerance) if tolerance else None)
        except ValueError:
            raise KnownLengthError(
                f"the known length is {text!r}: use X1 Y1 X2 Y2 METRES, then 'measured' if it was, or X1 Y1 X2 Y2 and "
                "a name of 'vehanchor models --sizes'"
            ) from None
        return cls.of((x1, y1, x2, y2, *values))

    @property
    def length_px(self) -> float:
        """Length of the line in pixels."""
        return math.hypot(self.x2 - self.x1, self.y2 - self.y1)


def number_or_name(text: str) -> float | str:
    """Read a number; a text that begins with a letter is a name.

    Raises:
        ValueError: the text is neither.
    """
    return text if text[:1].isalpha() and text.lower() not in ("nan", "inf", "infinity") else float(text)


def names_of_text(text: str) -> tuple[str, ...]:
    """Read names with commas."""
    return tuple(name.strip() for name in text.split(","))


@dataclass(frozen=True)
class Rulers:
    """Rulers to use, and known facts about the scale.

    Attributes:
        rulers: kinds of the rulers to use; None for all. ``vehanchor.records.ruler_kinds`` lists them.
        metadata: use the camera's metadata in the file; False is the paper's case.
        known_lengths: lines of known length: x1, y1, x2, y2 in pixels, metres or the name of a thing of known
            size, and optionally the basis and the tolerance; see ``KnownLength``.
        height_m: height of the camera above the ground, metres; the view is at nadir unless metadata or courts show a
            tilt.
        height_basis: how the height is known.
        height_tolerance_m: half of the 95 % interval of the height, metres; None for the default of its basis.
        focal_35mm: 35 mm equivalent focal length, millimetres, for this height or the file's; None takes the file's.
        stated_scale: scale from elsewhere; None without one.

    Raises:
        KnownLengthError: a known length is invalid.
        InvalidParameterError: a number is invalid, or the rulers are not a list of names.
    """

    panel: ClassVar[str] = "Other rulers"

    rulers: tuple[str, ...] | None = field(
        default=None,
        metadata=option("Rulers to use, with commas. Default: all.", metavar="NAMES", read=names_of_text),
    )
    metadata: bool = field(
        default=True,
        metadata=option("Use the camera's height and focal length if the file has them.", Flag()),
    )
    known_lengths: tuple[KnownLength, ...] = field(
        default=(),
        metadata=option(
            "Lines: metres, or a name, as iso_container_20ft; basis measured: tape, plan, survey.",
            metavar="X1 Y1 X2 Y2 METRES[+-M] [measured]|NAME",
            flag="known-length",
            read=KnownLength.from_text,
            repeated=True,
            first=True,
        ),
    )
    height_m: float | None = field(
        default=None,
        metadata=option(
            "Camera height above ground, for a nadir view or a known tilt.",
            _HEIGHT_M,
            metavar="M",
            first=True,
        ),
    )
    height_basis: Basis = field(
        default="assumed",
        metadata=option("How the height is known.", _BASES),
    )
    height_tolerance_m: float | None = field(
        default=None,
        metadata=option("With the height: half of its 95 % interval, metres.", _HEIGHT_M, metavar="M"),
    )
    focal_35mm: float | None = field(
        default=None,
        metadata=option("35 mm equivalent focal length, mm. Default: the file's.", _FOCAL_MM, metavar="MM"),
    )

    stated_scale: StatedScale | None = None

    def __post_init__(self) -> None:
        if self.rulers is not None:
            set_frozen(self, "rulers", _ruler_names(self.rulers))
        set_frozen(self, "known_lengths", _lines(self.known_lengths))
        lonely = ["height_tolerance_m"] if self.height_tolerance_m is not None else []
        lonely += ["focal_35mm"] if self.focal_35mm is not None and not self.metadata else []
        lonely += ["height_basis"] if self.height_basis == "measured" else []
        if lonely and self.height_m is None:
            raise InvalidParameterError(f"{lonely[0]} needs height_m: also give the height above the ground")
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
    try:
        return tuple(map(KnownLength.of, lines))
    except TypeError:
        raise KnownLengthError(f"known_lengths is {lines!r}: give lines of x1, y1, x2, y2, metres") from None
