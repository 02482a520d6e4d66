"""Fields that the records of areas and distances share, each declared once."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from vehanchor.records.gsd_estimate import GsdEstimate
from vehanchor.records.known_scale import KnownScale
from vehanchor.records.notices import Notice

ScaleSource = Literal["estimated", "given", "reused"]

MeasuredConfidence = Annotated[
    float | None,
    Field(ge=0, le=1, description="The scale's confidence in 0..1; null for a number that the caller gave."),
]
MeasuredGsd = Annotated[
    float | None,
    Field(description="Ground sampling distance, metres per pixel of the full image; null without a scale."),
]
MeasuredVehicles = Annotated[
    int | None, Field(ge=0, description="N': vehicles behind the scale; null unless it was estimated now.")
]
ScaleSourceField = Annotated[
    ScaleSource,
    Field(
        description="estimated: from this image, by the rulers in estimate. given: a number from the caller. reused: "
        "an earlier estimate of this image, given back."
    ),
]
ScaleField = Annotated[
    KnownScale | None,
    Field(description="The scale to give back for more measurements in this image; null for a number or no scale."),
]
EstimateField = Annotated[
    GsdEstimate | None, Field(description="The whole estimate of the scale; null unless it was estimated now.")
]
ImageWidth = Annotated[int, Field(gt=0, description="Width of the full image, pixels.")]
ImageHeight = Annotated[int, Field(gt=0, description="Height of the full image, pixels.")]
MeasuredWarnings = Annotated[
    tuple[Notice, ...], Field(description="Further facts about this result and its scale, each with a stable code.")
]
