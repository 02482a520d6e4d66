"""Tool arguments that determine the scale, and their conversion to the library's options."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, TypeAlias

from pydantic import ConfigDict, Field

from vehanchor.errors import InvalidParameterError
from vehanchor.options import (
    AddedVehicle,
    Basis,
    ByHand,
    Coordinates,
    Effort,
    Frame,
    KnownLength,
    Reading,
    Reference,
    Rulers,
    ScaleOptions,
    Search,
)
from vehanchor.options.by_hand import vehicle_numbers
from vehanchor.options.frame import FRAME, FRAME_SIDE
from vehanchor.options.given_scale import GSD_M_PER_PX, OBJECT_HEIGHT
from vehanchor.options.rulers import LINE_LENGTH_M, StatedScale
from vehanchor_server.calls.reply import Detail
from vehanchor_server.errors import CallError
from vehanchor_server.frozen import FrozenModel, Number, WholeNumber
from vehanchor_server.tools.option_field import limits_field, option_field

if TYPE_CHECKING:
    from vehanchor_server.models import Models
    from vehanchor_server.settings import Settings


_MOST_NUMBERS_TEXT = 4000  # 1000 numbers of three digits with commas
_MOST_ADDED = 64  # of at most 1000 values in a call


class FrameSize(FrozenModel):
    """Size of the resized copy in which the caller works."""

    width_px: Annotated[WholeNumber, limits_field(FRAME_SIDE)]
    height_px: Annotated[WholeNumber, limits_field(FRAME_SIDE)]


_Name = Annotated[str, Field(max_length=64, pattern="^[A-Za-z]")]


class KnownLine(FrozenModel):
    """A straight line of known length on the ground."""

    model_config = ConfigDict(json_schema_extra=lambda schema: schema.pop("description"))  # else models see no basis

    x1: Number
    y1: Number
    x2: Number
    y2: Number
    metres: Annotated[Number, limits_field(LINE_LENGTH_M)] | _Name
    basis: Basis = "assumed"
    tolerance_m: Annotated[Number | None, limits_field(LINE_LENGTH_M)] = None

    def known_length(self) -> KnownLength:
        """Convert to the library's line.

        Raises:
            KnownLengthError: it names a thing and says more about its length.
        """
        ends = (self.x1, self.y1, self.x2, self.y2)
        return KnownLength.of((*ends, self.metres, self.basis, self.tolerance_m))


class CarAxis(FrozenModel):
    """Both ends of a car's long axis."""

    model_config = ConfigDict(json_schema_extra=lambda schema: schema.pop("description"))  # the argument describes it

    x1: Number
    y1: Number
    x2: Number
    y2: Number


RegionArgument: TypeAlias = Annotated[str | None, option_field("region")]
ReferenceLengthArgument: TypeAlias = Annotated[Number | None, option_field("reference_length_m")]
FrameArgument: TypeAlias = Annotated[
    FrameSize | None, option_field(FRAME), Field(examples=[{"width_px": 1024, "height_px": 768}])
]
CoordinatesArgument: TypeAlias = Annotated[Coordinates, option_field("coordinates")]
GsdArgument: TypeAlias = Annotated[
    Number | None,
    limits_field(GSD_M_PER_PX),
    Field(description="Metres per pixel by a map or sister photograph."),
]
GsdBasisArgument: TypeAlias = Annotated[
    Basis, Field(description="measured: leads, without a search. assumed: other evidence must agree.")
]
GsdToleranceArgument: TypeAlias = Annotated[
    Number | None, limits_field(GSD_M_PER_PX), Field(description="Half of its 95 % interval, m/px. Default: 10 %.")
]
DetailArgument: TypeAlias = Annotated[Detail, Field(description="full: every field, for programs.")]
KnownLengthsArgument: TypeAlias = Annotated[
    tuple[KnownLine, ...] | None,
    Field(max_length=16, examples=[[{"x1": 210, "y1": 90, "x2": 880, "y2": 90, "metres": "iso_container_40ft"}]]),
    option_field("known_lengths"),
]
HeightArgument: TypeAlias = Annotated[Number | None, option_field("height_m")]
HeightBasisArgument: TypeAlias = Annotated[Basis, option_field("height_basis")]
HeightToleranceArgument: TypeAlias = Annotated[Number | None, option_field("height_tolerance_m")]
FocalLengthArgument: TypeAlias = Annotated[Number | None, option_field("focal_35mm")]
ConfirmArgument: TypeAlias = Annotated[str | None, Field(max_length=_MOST_NUMBERS_TEXT), option_field("confirm")]
DropArgument: TypeAlias = Annotated[str | None, Field(max_length=_MOST_NUMBERS_TEXT), option_field("drop")]
AddArgument: TypeAlias = Annotated[tuple[CarAxis, ...] | None, Field(max_length=_MOST_ADDED), option_field("add")]
ObjectHeightArgument: TypeAlias = Annotated[Number | None, option_field(OBJECT_HEIGHT)]
EffortArgument: TypeAlias = Annotated[Effort | None, option_field("effort")]
MaxTilesArgument: TypeAlias = Annotated[WholeNumber | None, option_field("max_tiles")]
MaxSecondsArgument: TypeAlias = Annotated[Number | None, option_field("max_seconds")]

UNLISTED_ARGUMENTS = (
    "detail",
    "reference_length_m",
    "height_tolerance_m",
    "tolerance_m",
    "gsd_tolerance",
    "object_height_m",
    "overlay_side_px",
    "effort",
    "max_tiles",
    "max_seconds",
    "more_images",
    "same_scale",
    "add",
)
"""Arguments and fields that the listed schemas hide from models; programs set them."""


@dataclass(frozen=True)
class ScaleQuestion:
    """Arguments of a call that determine an estimate.

    Attributes:
        region: where the image was taken.
        reference_length_m: length of local cars.
        frame: size of the caller's resized copy.
        known_lengths: lines that the caller has measured.
        height_m: camera height above ground.
        height_basis: how the height is known.
        height_tolerance_m: half of its 95 % interval.
        focal_35mm: 35 mm equivalent focal length.
        coordinates: coordinate system.
        effort: extent of the search in large images; None for the operator's setting.
        max_tiles: maximum number of tiles; the operator's limit also applies.
        max_seconds: maximum search time; the operator's limit also applies.
        confirm: numbers of vehicles that are cars, as "1-20,23".
        drop: numbers of vehicles that are no cars.
        add: cars that were not found.
        stated: a scale from elsewhere.
    """

    region: str | None = None
    reference_length_m: float | None = None
    frame: FrameSize | None = None
    known_lengths: tuple[KnownLine, ...] | None = None
    height_m: float | None = None
    height_basis: Basis = "assumed"
    height_tolerance_m: float | None = None
    focal_35mm: float | None = None
    coordinates: Coordinates = "pixels"
    effort: Effort | None = None
    max_tiles: int | None = None
    max_seconds: float | None = None
    confirm: str | None = None
    drop: str | None = None
    add: tuple[CarAxis, ...] | None = None
    stated: StatedScale | None = None

    @property
    def by_hand(self) -> ByHand:
        """Corrections of the vehicles.

        Raises:
            InvalidParameterError: a number is invalid.
        """
        return ByHand(
            confirm=vehicle_numbers("confirm", self.confirm or ""),
            drop=vehicle_numbers("drop", self.drop or ""),
            add=tuple(AddedVehicle(each.x1, each.y1, each.x2, each.y2) for each in self.add or ()),
        )

    def options(self, settings: Settings, models: Models | None) -> ScaleOptions:
        """Return the options: limits and calibration of the operator, all others of the caller.

        If the caller gives a region or a reference length, the operator's calibration is not used.

        Args:
            settings: the operator's settings.
            models: source of the calibration; None if the scale is known.

        Raises:
            CallError: the calibration cannot be loaded.
            InvalidParameterError: the caller's options contradict each other.
        """
        width_px, height_px = (self.frame.width_px, self.frame.height_px) if self.frame else (None, None)
        fleet_unknown = self.region is None and self.reference_length_m is None
        return ScaleOptions(
            search=Search(effort=self.effort or Search.effort, max_tiles=self.max_tiles, max_seconds=self.max_seconds),
            reference=Reference(
                reference_length_m=self.reference_length_m,
                region=self.region,
                calibration=models.calibration() if models and fleet_unknown else None,
            ),
            frame=Frame(width_px, height_px, self.coordinates),
            reading=Reading(limits=settings.image_limits),
            rulers=Rulers(
                known_lengths=tuple(line.known_length() for line in self.known_lengths or ()),
                height_m=self.height_m,
                height_basis=self.height_basis,
                height_tolerance_m=self.height_tolerance_m,
                focal_35mm=self.focal_35mm,
                stated_scale=self.stated,
            ),
            by_hand=self.by_hand,
        )


def stated_scale(gsd_m_per_px: float | None, basis: Basis, tolerance: float | None) -> StatedScale | None:
    """Combine the arguments of a scale from elsewhere; None without one.

    Raises:
        CallError: basis or tolerance are given without the scale, or the tolerance is as large as the scale.
    """
    if gsd_m_per_px is not None:
        try:
            return StatedScale.of(gsd_m_per_px, basis, tolerance)
        except InvalidParameterError as error:
            raise CallError(error.code, f"{error}.") from error
    if basis == "measured" or tolerance is not None:
        raise CallError("invalid_arguments", "gsd_basis and gsd_tolerance need gsd_m_per_px: give the scale, too.")
    return None
