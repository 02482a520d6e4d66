"""Tool arguments that determine the scale, and their conversion to the library's options."""

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
    """Size of the resized copy in which the caller works."""

    width_px: WholeNumber = Field(gt=0, le=1_000_000)
    height_px: WholeNumber = Field(gt=0, le=1_000_000)


class KnownLine(FrozenModel):
    """A straight line of known length on the ground."""

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
        description="Known length of local cars, metres; not with region.",
    ),
]
FrameArgument: TypeAlias = Annotated[FrameSize | None, Field(description="Size of the copy that you see.")]
CoordinatesArgument: TypeAlias = Annotated[
    Coordinates,
    Field(description="Units: pixels (of image or frame), fraction (0 to 1), per_mille (0 to 1000)."),
]
KnownScaleArgument: TypeAlias = Annotated[
    KnownScale | None,
    Field(description="From an earlier answer about this image."),
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
        description="Lines of known length; rulers with or without cars.",
    ),
]
HeightArgument: TypeAlias = Annotated[
    Number | None,
    Field(gt=0, le=20_000, allow_inf_nan=False, description="Camera height above ground, metres, for a nadir view."),
]
FocalLengthArgument: TypeAlias = Annotated[
    Number | None,
    Field(
        gt=0,
        le=10_000,
        allow_inf_nan=False,
        description="With height_m: 35 mm equivalent focal length; default the file's.",
    ),
]

ObjectHeightArgument: TypeAlias = Annotated[
    Number | None,
    Field(
        ge=0,
        le=1000,
        allow_inf_nan=False,
        description="Height of the object above ground, such as a roof; needs the camera height or focal length.",
    ),
]
EffortArgument: TypeAlias = Annotated[
    Effort | None,
    Field(description="Search extent: full (every tile), auto (ends when more tiles would not help) or fast."),
]
MaxTilesArgument: TypeAlias = Annotated[
    WholeNumber | None, Field(ge=1, le=1_000_000_000, description="Maximum number of tiles to search.")
]
MaxSecondsArgument: TypeAlias = Annotated[
    Number | None, Field(gt=0, le=86_400, allow_inf_nan=False, description="Maximum search time in seconds.")
]

EFFORT_ARGUMENTS = ("effort", "max_tiles", "max_seconds")
"""Arguments that ``estimate_gsd`` hides from models; programs or the operator set them."""

UNLISTED_ARGUMENTS = (
    "region",
    "reference_length_m",
    "known_lengths",
    "height_m",
    "focal_35mm",
    "object_height_m",
)
"""Arguments that the measuring tools hide from models; models pass them to ``estimate_gsd``."""


_Number = TypeVar("_Number", int, float)


def _least(*limits: _Number | None) -> _Number | None:
    """Return the smallest limit that is set, or None."""
    return min((limit for limit in limits if limit is not None), default=None)


@dataclass(frozen=True)
class ScaleQuestion:
    """Arguments of a call that determine an estimate.

    Attributes:
        region: where the image was taken.
        reference_length_m: length of local cars.
        frame: size of the caller's resized copy.
        known_lengths: lines that the caller has measured.
        height_m: camera height above ground.
        focal_35mm: 35 mm equivalent focal length.
        coordinates: coordinate system.
        effort: extent of the search in large images; None for the operator's setting.
        max_tiles: maximum number of tiles; the operator's limit also applies.
        max_seconds: maximum search time; the operator's limit also applies.
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
        """Return the options: thresholds, limits and calibration of the operator, all others of the caller.

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
