"""Options of rulers: which to use, known facts about the scale, and vehicles by hand."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from typing import Annotated, Any, ClassVar, Literal, NamedTuple, TypeAlias, get_args

from pydantic import BeforeValidator, Field, WithJsonSchema

from vehanchor.errors import InvalidParameterError, KnownLengthError
from vehanchor.options.option import UNLISTED, Flag, Limits, Number, Option, group, in_order
from vehanchor.scale.defaults import MAX_GSD_M_PER_PX, MIN_GSD_M_PER_PX

GSD_M_PER_PX = Limits(MIN_GSD_M_PER_PX, MAX_GSD_M_PER_PX)
OBJECT_HEIGHT_M = Limits(0, 1000, unit="m")

GSD = Option(
    "Known metres per pixel of the full image; skips the search.", metavar="M/PX", flag="gsd"
)
OBJECT_HEIGHT = Option(
    "Height of the object above ground, such as a roof; needs the camera's height or focal length.",
    metavar="M",
    flag="object-height",
)

ObjectHeight: TypeAlias = Annotated[Annotated[float, OBJECT_HEIGHT_M] | None, OBJECT_HEIGHT]
"""Argument of tools."""

MAX_BY_HAND = 1000
"""Maximum number of vehicles in either list."""

_MAX_DROP_CHARS = 4000  # 1000 numbers of three digits with commas
_VEHICLE_NUMBER = Limits(1, 1_000_000, whole=True)
# An error of a pixel at each end exceeds a quarter of a shorter line.
_MIN_LINE_PX = 5.0


@group(frozen=True)
class Segment:
    """Straight line in a picture.

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
        """Length of the line in pixels."""
        return math.hypot(self.x2 - self.x1, self.y2 - self.y1)

    def check(
        self, name: str, error: type[InvalidParameterError], size: tuple[int, int] | None = None
    ) -> None:
        """Check that the line is long enough and inside the picture.

        Args:
            name: name of the line in messages.
            error: class of the error.
            size: width and height of the picture, pixels; None checks only the length.

        Raises:
            InvalidParameterError: the line is shorter than five pixels, or an end is outside.
        """
        if self.length_px < _MIN_LINE_PX:
            raise error(
                f"{name} is {self.length_px:.1f} px long: give both ends of one of "
                f"{_MIN_LINE_PX:g} px or more"
            )
        if size is None:
            return
        width, height = size
        first_inside = 0 <= self.x1 <= width and 0 <= self.y1 <= height
        second_inside = 0 <= self.x2 <= width and 0 <= self.y2 <= height
        if not (first_inside and second_inside):
            raise error(
                f"{name}, from ({self.x1:g}, {self.y1:g}) to ({self.x2:g}, {self.y2:g}), leaves "
                f"the picture of {width} x {height} px: give both ends in its pixels"
            )


@group(frozen=True)
class AddedVehicle(Segment):
    """Car that the detector missed: both ends of its long axis."""


def vehicle_numbers(value: Any) -> Any:
    """Read numbers of vehicles: a list, or a text with numbers and ranges such as "1-20,23".

    Raises:
        InvalidParameterError: the value is something else, or there are too many numbers.
    """
    if isinstance(value, str):
        numbers = _numbers_in_text(value)
    elif isinstance(value, int) and not isinstance(value, bool):
        numbers = [value]
    elif isinstance(value, Iterable):
        numbers = list(value)
    else:
        raise InvalidParameterError(
            f"drop is {value!r}: give a list of numbers of vehicles, such as 1-20,23"
        )
    if len(numbers) > MAX_BY_HAND:
        raise InvalidParameterError(f"drop has {len(numbers)} vehicles: give at most {MAX_BY_HAND}")
    checked = [int(_VEHICLE_NUMBER.check("drop", number)) for number in numbers]
    # A number that is repeated counts once; the order stays.
    return tuple(dict.fromkeys(checked))


def _numbers_in_text(text: str) -> list[int]:
    """Read numbers and ranges, with commas or spaces between them."""
    numbers: list[int] = []
    for part in text.replace(",", " ").split():
        first, dash, last = part.partition("-")
        if not dash:
            last = first
        if not first.isdecimal() or not last.isdecimal():
            raise InvalidParameterError(
                f"drop is {text!r}: use numbers and ranges with commas, such as 1-20,23"
            )
        low = int(first)
        high = int(last)
        if high < low or high - low >= MAX_BY_HAND:
            raise InvalidParameterError(
                f"drop has the range {part}: use rising ranges of at most {MAX_BY_HAND}"
            )
        numbers += range(low, high + 1)
    return numbers


@group(frozen=True)
class ByHand:
    """Vehicles that the caller drops or adds.

    Numbers are those in the pictures: 1 is the best detection. They hold for one image, one
    detector and the same search options.

    Attributes:
        drop: numbers of detections that are not cars.
        add: missed cars: x1, y1, x2, y2 of the long axis, from bumper to bumper.

    Raises:
        InvalidParameterError: a number or an axis is invalid.
    """

    drop: Annotated[
        tuple[int, ...],
        BeforeValidator(vehicle_numbers),
        WithJsonSchema({"type": "string", "maxLength": _MAX_DROP_CHARS}),
        Option(
            "Numbers of overlay boxes that are not cars, such as 3,7-9.",
            metavar="N,N-N",
            first=True,
            tools="all",
        ),
    ] = ()
    add: Annotated[
        tuple[Annotated[AddedVehicle, in_order("x1", "y1", "x2", "y2")], ...],
        Field(max_length=MAX_BY_HAND),
        Option(
            "Cars that the detector missed: both ends of the long axis of each.",
            metavar="X1 Y1 X2 Y2",
            repeated=True,
            first=True,
            tools="all",
        ),
    ] = ()

    @property
    def given(self) -> str | None:
        """Name of the first list with vehicles; None without any."""
        if self.drop:
            return "drop"
        return "add" if self.add else None


Basis: TypeAlias = Literal["assumed", "measured"]
"""How a fact is known: by a standard or an inference, or by tape, plan or survey."""

# Half of the 95 % interval of a stated scale without a tolerance, as a share of it; our choice.
_STATED_TOLERANCE = 0.1
_Length = Annotated[float, Limits(above=0, most=100_000, unit="m")]
# A line may span several equal things in a row, such as "9 x parking_bay_width".
_COUNT_PATTERN = "[1-9][0-9]{0,2} *[x*] *"
_Name = Annotated[str, Field(max_length=64, pattern=f"^({_COUNT_PATTERN})?[A-Za-z]")]
# Survey aircraft fly at 10 km.
Height: TypeAlias = Annotated[float, Limits(above=0, most=20_000, unit="m")]
FocalLength: TypeAlias = Annotated[float, Limits(above=0, most=10_000, unit="mm")]
_Gsd = Annotated[float, GSD_M_PER_PX]


class StatedScale(NamedTuple):
    """Scale from elsewhere, such as a map or a sister photograph.

    Attributes:
        gsd_m_per_px: metres per pixel of the full image.
        basis: how it is known.
        tolerance: half of its 95 % interval, metres per pixel.
    """

    gsd_m_per_px: float
    basis: Basis
    tolerance: float


@group(frozen=True)
class KnownLength(Segment):
    """Straight line on the ground with its known length.

    Attributes:
        metres: length of the line; or the name of a thing of known size in
            ``vehanchor.rulers.standards``, with an optional country, such as "railway_gauge/ES",
            and the number of such things in a row, such as "9 x parking_bay_width".
        basis: how the length is known: assumed, or measured by tape, plan or survey.
        tolerance_m: half of the 95 % interval of the length, metres; None for the default of the
            basis.

    Raises:
        KnownLengthError: a value is missing or invalid.
    """

    error: ClassVar[type[InvalidParameterError]] = KnownLengthError

    metres: _Length | _Name
    basis: Basis = "assumed"
    tolerance_m: Annotated[_Length | None, UNLISTED] = None

    def __post_init__(self) -> None:
        if self.what is not None and (self.basis == "measured" or self.tolerance_m is not None):
            raise KnownLengthError(
                f"a thing of known size, {self.what!r}, has no basis or tolerance"
            )

    @property
    def what(self) -> str | None:
        """Name of the thing of known size, without its count; None for a length in metres."""
        if not isinstance(self.metres, str):
            return None
        return re.sub(f"^{_COUNT_PATTERN}", "", self.metres)

    @property
    def n_things(self) -> int:
        """Number of equal things in a row that the line spans."""
        if not isinstance(self.metres, str):
            return 1
        count = re.match("[0-9]+", self.metres)
        return 1 if count is None else int(count.group())

    @property
    def length_m(self) -> float | None:
        """Length in metres; None for a thing of known size."""
        return None if isinstance(self.metres, str) else self.metres


def _split_line(value: Any) -> Any:
    """Split the text of a known length into its values; leave other values as they are.

    The text is ``X1 Y1 X2 Y2 METRES[+-TOLERANCE] [measured]`` or ``X1 Y1 X2 Y2 [N x] NAME``.
    """
    if not isinstance(value, str):
        return value
    parts = value.replace(",", " ").split()
    basis = "assumed"
    if parts and parts[-1] in get_args(Basis):
        basis = parts.pop()
    is_row = len(parts) == 7 and parts[5] in ("x", "*")
    if len(parts) != 5 and not is_row:
        raise KnownLengthError(
            f"the known length is {value!r}: use X1 Y1 X2 Y2 METRES, then 'measured' if it was, or "
            "X1 Y1 X2 Y2 and a name of 'vehanchor models --sizes'"
        )
    ends = parts[:4]
    length = " ".join(parts[4:])
    metres, _, tolerance = length.partition("+-")
    return (*ends, metres, basis, tolerance or None)


_Line = Annotated[
    KnownLength,
    in_order("x1", "y1", "x2", "y2", "metres", "basis", "tolerance_m"),
    BeforeValidator(_split_line),
]


def _split_names(value: Any) -> Any:
    """Split a text with names between commas; leave other values as they are."""
    if isinstance(value, str):
        return [name.strip() for name in value.split(",")]
    return value


@group(frozen=True)
class Rulers:
    """Rulers to use, and known facts about the scale.

    Attributes:
        rulers: kinds of the rulers to use; None for all. ``vehanchor.records.ruler_registry`` lists
            them.
        metadata: use the camera's metadata in the file; False is the paper's case.
        known_lengths: lines of known length: x1, y1, x2, y2 in pixels, metres or the name of a
            thing of known size, and optionally the basis and the tolerance; see ``KnownLength``.
        height_m: height of the camera above the ground, metres; the view is at nadir unless
            metadata or courts show a tilt.
        height_basis: how the height is known.
        height_tolerance_m: half of the 95 % interval of the height, metres; None for the default of
            the basis.
        focal_35mm: 35 mm equivalent focal length, millimetres, for this height or the file's; None
            uses the file's.
        gsd_m_per_px: scale from elsewhere, metres per pixel of the full image.
        gsd_basis: how that scale is known.
        gsd_tolerance: half of its 95 % interval, metres per pixel; None for a tenth of it.
        file_scale: measure areas and distances in a georeferenced file with its own scale, unless
            vehicles contradict it. Estimates never use it.

    Raises:
        KnownLengthError: a known length is invalid.
        InvalidParameterError: a number is invalid, or the rulers are not a list of names.
    """

    rulers: Annotated[
        Annotated[tuple[str, ...], BeforeValidator(_split_names)] | None,
        Option("Rulers to use, with commas. Default: all.", metavar="NAMES", first=True),
    ] = None
    metadata: Annotated[
        Flag,
        Option(
            "Use the file's camera height and focal length.",
            first=True,
            tools="all",
        ),
    ] = True
    known_lengths: Annotated[
        tuple[_Line, ...],
        Field(
            examples=[[{"x1": 210, "y1": 90, "x2": 880, "y2": 90, "metres": "iso_container_40ft"}]]
        ),
        Option(
            "Lines of known length on the ground: both ends, and either metres or a catalogue name "
            'such as iso_container_20ft. Use basis "measured" only for a tape, plan or survey.',
            metavar="X1 Y1 X2 Y2 METRES[+-M] [measured]|NAME",
            flag="known-length",
            repeated=True,
            first=True,
            tools="all",
            error=KnownLengthError,
        ),
    ] = ()
    height_m: Annotated[
        Height | None,
        Option(
            "Height of the camera above the ground, for a nadir view or a known tilt.",
            metavar="M",
            first=True,
            tools="all",
        ),
    ] = None
    height_basis: Annotated[Basis, Option("How the height is known.", first=True, tools="all")] = (
        "assumed"
    )
    height_tolerance_m: Annotated[
        Height | None,
        Option(
            "With the height: half of its 95 % interval, metres.",
            metavar="M",
            tools="all",
            listed=False,
        ),
    ] = None
    focal_35mm: Annotated[
        FocalLength | None,
        Option(
            "Focal length as its 35 mm equivalent, mm. Default: the file's.",
            metavar="MM",
            first=True,
            tools="all",
        ),
    ] = None
    gsd_m_per_px: Annotated[
        _Gsd | None,
        Option("Metres per pixel from a map or sister photograph.", cli=False, tools="measure"),
    ] = None
    gsd_basis: Annotated[
        Basis,
        Option(
            "measured: this scale leads, without a search. assumed: other evidence must agree.",
            cli=False,
            tools="measure",
        ),
    ] = "assumed"
    gsd_tolerance: Annotated[
        _Gsd | None,
        Option(
            "Half of its 95 % interval, m/px. Default: 10 %.",
            cli=False,
            tools="measure",
        ),
    ] = None
    file_scale: Annotated[
        Flag,
        Option(
            "Measure with the scale of a georeferenced file, unless vehicles contradict it.",
            cli=False,
            tools="measure",
            listed=False,
        ),
    ] = True

    def __post_init__(self) -> None:
        if self.rulers == ():
            raise InvalidParameterError("rulers is empty: name at least one, or leave it out")
        self._check_height()
        self._check_stated_scale()

    def _check_height(self) -> None:
        """Refuse facts about a height without the height itself."""
        if self.height_m is not None:
            return
        if self.height_tolerance_m is not None:
            unused = "height_tolerance_m"
        elif self.focal_35mm is not None and not self.metadata:
            unused = "focal_35mm"  # Without metadata, the file's height is not used either.
        elif self.height_basis == "measured":
            unused = "height_basis"
        else:
            return
        raise InvalidParameterError(
            f"{unused} needs height_m: also give the height above the ground"
        )

    def _check_stated_scale(self) -> None:
        """Refuse facts about a scale without the scale itself, and a tolerance as large as it."""
        scale = self.stated_scale
        if scale is None:
            if self.gsd_basis == "measured" or self.gsd_tolerance is not None:
                raise InvalidParameterError(
                    "gsd_basis and gsd_tolerance need gsd_m_per_px: give the scale, too"
                )
        elif scale.tolerance >= scale.gsd_m_per_px:
            raise InvalidParameterError(
                f"gsd_tolerance is {scale.tolerance:g}, as large as the scale: give half of its 95 "
                "% interval"
            )

    @property
    def stated_scale(self) -> StatedScale | None:
        """Scale from elsewhere; None without one."""
        gsd = self.gsd_m_per_px
        if gsd is None:
            return None
        tolerance = self.gsd_tolerance or _STATED_TOLERANCE * gsd
        return StatedScale(gsd, self.gsd_basis, tolerance)
