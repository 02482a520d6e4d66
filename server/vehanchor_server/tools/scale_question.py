"""Arguments about an image's scale, which several tools take, and the library's options that follow from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, TypeAlias, TypeVar, cast

from pydantic import Field

from vehanchor.options import Coordinates, Effort, Frame, KnownLength, Reading, Reference, Rulers, ScaleOptions, Search
from vehanchor.records import KnownScale
from vehanchor.scale.defaults import REGIONS
from vehanchor_server.calls.answer import Detail
from vehanchor_server.frozen import FrozenModel, Number, WholeNumber

if TYPE_CHECKING:
    from vehanchor_server.models import Models
    from vehanchor_server.settings import Settings


class FrameSize(FrozenModel):
    """Size of the resized copy of the image that the caller sees and works in."""

    width_px: WholeNumber = Field(gt=0, le=1_000_000)
    height_px: WholeNumber = Field(gt=0, le=1_000_000)


class KnownLine(FrozenModel):
    """A straight line on the ground and its length."""

    x1: Number
    y1: Number
    x2: Number
    y2: Number
    metres: Number = Field(gt=0, le=100_000)


RegionArgument: TypeAlias = Annotated[
    str | None,
    Field(
        max_length=64,
        description=f"Where it was taken, if known: {', '.join(REGIONS)}.",
    ),
]
ReferenceLengthArgument: TypeAlias = Annotated[
    Number | None,
    Field(
        gt=0,
        le=100,
        allow_inf_nan=False,
        description="Car length there, if better known; not with region.",
    ),
]
FrameArgument: TypeAlias = Annotated[FrameSize | None, Field(description="Size of the copy that you see.")]
CoordinatesArgument: TypeAlias = Annotated[
    Coordinates,
    Field(description="Of places: pixels (of image or frame), fraction (0 to 1), per_mille (0 to 1000)."),
]
KnownScaleArgument: TypeAlias = Annotated[
    KnownScale | None,
    Field(description="Of an earlier answer about this image."),
]
GsdArgument: TypeAlias = Annotated[
    Number | None,
    Field(ge=0.0001, le=1000, allow_inf_nan=False, description="Metres per pixel of the full image, if known."),
]
DetailArgument: TypeAlias = Annotated[Detail, Field(description="full: every field, for programs.")]
KnownLengthsArgument: TypeAlias = Annotated[
    tuple[KnownLine, ...] | None,
    Field(
        max_length=16,
        description="Lines of known length: rulers beside the cars, or without any.",
    ),
]
HeightArgument: TypeAlias = Annotated[
    Number | None,
    Field(
        gt=0, le=20_000, allow_inf_nan=False, description="Camera's height above the ground, metres, if it looked down."
    ),
]
FocalLengthArgument: TypeAlias = Annotated[
    Number | None,
    Field(
        gt=0,
        le=10_000,
        allow_inf_nan=False,
        description="With height_m: focal length as on 35 mm film; else the file's.",
    ),
]

ObjectHeightArgument: TypeAlias = Annotated[
    Number | None,
    Field(
        ge=0,
        le=1000,
        allow_inf_nan=False,
        description="Height of what is measured above the ground, as of a roof; needs the camera's height or lens.",
    ),
]
EffortArgument: TypeAlias = Annotated[
    Effort | None,
    Field(description="How much is searched: full (every tile), auto (ends when more would not help) or fast."),
]
MaxTilesArgument: TypeAlias = Annotated[
    WholeNumber | None, Field(ge=1, le=1_000_000_000, description="Tiles to search at most.")
]
MaxSecondsArgument: TypeAlias = Annotated[
    Number | None, Field(gt=0, le=86_400, allow_inf_nan=False, description="Seconds to search at most.")
]

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
