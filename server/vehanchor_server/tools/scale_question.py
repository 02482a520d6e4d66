"""Arguments about an image's scale, which several tools take, and the library's options that follow from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, TypeAlias, TypeVar, cast

from pydantic import Field

from vehanchor.options import Coordinates, Effort, Frame, KnownLength, Reading, Reference, Rulers, ScaleOptions, Search
from vehanchor.options.frame import FRAME, FRAME_SIDE
from vehanchor.options.given_scale import GSD, OBJECT_HEIGHT
from vehanchor.options.rulers import LINE_LENGTH_M
from vehanchor.records import KnownScale
from vehanchor_server.calls.answer import Detail
from vehanchor_server.frozen import FrozenModel, Number, WholeNumber
from vehanchor_server.tools.option_field import limits_field, option_field

if TYPE_CHECKING:
    from vehanchor_server.models import Models
    from vehanchor_server.settings import Settings


class FrameSize(FrozenModel):
    """Size of the resized copy of the image that the caller sees and works in."""

    width_px: Annotated[WholeNumber, limits_field(FRAME_SIDE)]
    height_px: Annotated[WholeNumber, limits_field(FRAME_SIDE)]


class KnownLine(FrozenModel):
    """A straight line on the ground and its length."""

    x1: Number
    y1: Number
    x2: Number
    y2: Number
    metres: Annotated[Number, limits_field(LINE_LENGTH_M)]


RegionArgument: TypeAlias = Annotated[str | None, option_field("region")]
ReferenceLengthArgument: TypeAlias = Annotated[Number | None, option_field("reference_length_m")]
FrameArgument: TypeAlias = Annotated[FrameSize | None, option_field(FRAME)]
CoordinatesArgument: TypeAlias = Annotated[Coordinates, option_field("coordinates")]
KnownScaleArgument: TypeAlias = Annotated[
    KnownScale | None,
    Field(description="From an earlier answer about this image."),
]
GsdArgument: TypeAlias = Annotated[Number | None, option_field(GSD)]
DetailArgument: TypeAlias = Annotated[Detail, Field(description="full: every field, for programs.")]
KnownLengthsArgument: TypeAlias = Annotated[
    tuple[KnownLine, ...] | None, Field(max_length=16), option_field("known_lengths")
]
HeightArgument: TypeAlias = Annotated[Number | None, option_field("height_m")]
FocalLengthArgument: TypeAlias = Annotated[Number | None, option_field("focal_35mm")]
ObjectHeightArgument: TypeAlias = Annotated[Number | None, option_field(OBJECT_HEIGHT)]
EffortArgument: TypeAlias = Annotated[Effort | None, option_field("effort")]
MaxTilesArgument: TypeAlias = Annotated[WholeNumber | None, option_field("max_tiles")]
MaxSecondsArgument: TypeAlias = Annotated[Number | None, option_field("max_seconds")]

EFFORT_ARGUMENTS = ("effort", "max_tiles", "max_seconds")
"""Arguments of a search that estimate_gsd takes, but does not list: a program gives them, or the operator."""

UNLISTED_ARGUMENTS = (
    "region",
    "reference_length_m",
    "known_lengths",
    "height_m",
    "focal_35mm",
    "object_height_m",
)
"""Arguments that tools that measure take, but do not list: those of a search a model gives to estimate_gsd."""


_Number = TypeVar("_Number", int, float)


def _least(*limits: _Number | None) -> _Number | None:
    """The tightest of limits that are set; None for none."""
    return min((limit for limit in limits if limit is not None), default=None)


@dataclass(frozen=True)
class ScaleQuestion:
    """A caller's words about the scale it asks for.

    Attributes:
        region: where the image was taken.
        reference_length_m: the length of cars there.
        frame: the copy that the caller sees.
        known_lengths: lines that the caller has measured.
        height_m: of the camera above the ground.
        focal_35mm: its focal length.
        coordinates: how places are written.
        effort: how much of a large image is searched; None leaves it to the operator.
        max_tiles: to search at most; the operator's limit holds, too.
        max_seconds: to search at most; the operator's limit holds, too.
    """

    region: str | None = None
    reference_length_m: float | None = None
    frame: FrameSize | None = None
    known_lengths: tuple[KnownLine, ...] | None = None
    height_m: float | None = None
    focal_35mm: float | None = None
    coordinates: Coordinates = "pixels"
    effort: Effort | None = None
    max_tiles: int | None = None
    max_seconds: float | None = None

    def options(self, settings: Settings, models: Models | None) -> ScaleOptions:
        """The method's options: thresholds, limits and calibration by the operator, the rest by the caller.

        A caller who knows where the image was taken knows more than the operator's calibration, which is then left out.

        Args:
            settings: the operator's.
            models: have the calibration; None where the scale is known and no vehicle is searched.

        Raises:
            CallError: the calibration cannot be loaded.
            InvalidParameterError: the caller's options contradict each other.
        """
        width_px, height_px = (self.frame.width_px, self.frame.height_px) if self.frame else (None, None)
        fleet_unknown = self.region is None and self.reference_length_m is None
        return ScaleOptions(
            search=Search(
                min_score=settings.min_score,
                effort=self.effort or cast("Effort", settings.effort),
                max_tiles=_least(self.max_tiles, settings.max_tiles),
                max_seconds=_least(self.max_seconds, settings.max_search_s),
            ),
            reference=Reference(
                reference_length_m=self.reference_length_m,
                region=self.region,
                calibration=models.calibration() if models and fleet_unknown else None,
            ),
            frame=Frame(width_px, height_px, self.coordinates),
            reading=Reading(limits=settings.image_limits),
            rulers=Rulers(
                known_lengths=tuple(
                    KnownLength(line.x1, line.y1, line.x2, line.y2, line.metres) for line in self.known_lengths or ()
                ),
                height_m=self.height_m,
                focal_35mm=self.focal_35mm,
            ),
        )
