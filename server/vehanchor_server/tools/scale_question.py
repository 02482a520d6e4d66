"""Arguments about an image's scale, which several tools take, and the library's options that follow from them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, TypeAlias

from pydantic import Field

from vehanchor.options import Frame, KnownLength, Reading, Reference, Rulers, ScaleOptions, Search
from vehanchor_server.frozen import FrozenModel

if TYPE_CHECKING:
    from vehanchor_server.models import Models
    from vehanchor_server.settings import Settings

__all__ = [
    "FocalLengthArgument",
    "FrameArgument",
    "FrameSize",
    "HeightArgument",
    "KnownLengthsArgument",
    "KnownLine",
    "ReferenceLengthArgument",
    "RegionArgument",
    "ScaleQuestion",
]


class FrameSize(FrozenModel):
    """Size of the resized copy of the image that the caller sees and works in."""

    width_px: int = Field(gt=0, le=1_000_000, description="Width of that copy, pixels.")
    height_px: int = Field(gt=0, le=1_000_000, description="Height of that copy, pixels.")


class KnownLine(FrozenModel):
    """A straight line on the ground and its length."""

    x1: float = Field(allow_inf_nan=False, description="One end, pixels from the left.")
    y1: float = Field(allow_inf_nan=False, description="One end, pixels from the top.")
    x2: float = Field(allow_inf_nan=False, description="The other end.")
    y2: float = Field(allow_inf_nan=False, description="The other end.")
    metres: float = Field(gt=0, le=100_000, allow_inf_nan=False, description="Metres between them.")


RegionArgument: TypeAlias = Annotated[
    str | None,
    Field(
        max_length=64,
        description="Where the image was taken, if known: europe or north_america; cars differ in length.",
    ),
]
ReferenceLengthArgument: TypeAlias = Annotated[
    float | None,
    Field(
        gt=0,
        le=100,
        allow_inf_nan=False,
        description="Typical car length there in metres, if better known; not with region.",
    ),
]
FrameArgument: TypeAlias = Annotated[
    FrameSize | None, Field(description="Size of the resized copy that you see; its aspect ratio is the image's.")
]
KnownLengthsArgument: TypeAlias = Annotated[
    tuple[KnownLine, ...] | None,
    Field(
        max_length=16,
        description="Lines of known length, in pixels of the image, or of frame where that is given: rulers beside "
        "the vehicles, or without any.",
    ),
]
HeightArgument: TypeAlias = Annotated[
    float | None,
    Field(
        gt=0,
        le=20_000,
        allow_inf_nan=False,
        description="Height of the camera above the ground, metres, if known, for a picture taken straight down: a "
        "ruler, too. Not above the sea.",
    ),
]
FocalLengthArgument: TypeAlias = Annotated[
    float | None,
    Field(
        gt=0,
        le=10_000,
        allow_inf_nan=False,
        description="With height_m: focal length as on 35 mm film, mm; without it the file's.",
    ),
]


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
    """

    region: str | None = None
    reference_length_m: float | None = None
    frame: FrameSize | None = None
    known_lengths: tuple[KnownLine, ...] | None = None
    height_m: float | None = None
    focal_35mm: float | None = None

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
        fleet_unknown = self.region is None and self.reference_length_m is None
        return ScaleOptions(
            search=Search(min_score=settings.min_score),
            reference=Reference(
                reference_length_m=self.reference_length_m,
                region=self.region,
                calibration=models.calibration() if models and fleet_unknown else None,
            ),
            frame=Frame(self.frame.width_px, self.frame.height_px) if self.frame else Frame(),
            reading=Reading(limits=settings.image_limits),
            rulers=Rulers(
                known_lengths=tuple(
                    KnownLength(line.x1, line.y1, line.x2, line.y2, line.metres) for line in self.known_lengths or ()
                ),
                height_m=self.height_m,
                focal_35mm=self.focal_35mm,
            ),
        )
