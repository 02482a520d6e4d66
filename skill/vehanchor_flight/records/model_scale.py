"""The record of a reconstruction's size."""

from __future__ import annotations

from typing import Literal, TypeAlias

from pydantic import Field

from vehanchor.records.gsd_estimate import Status
from vehanchor.records.notices import Notice
from vehanchor.records.record import SCHEMA_VERSION, Record, SchemaVersion
from vehanchor.scale.defaults import Reason

ModelSource: TypeAlias = Literal["opensfm", "colmap_text", "colmap_binary"]


class ModelRuler(Record):
    """Ruler behind a model's size."""

    kind: str = Field(description="Kind of the ruler: vehicles, courts, known_length, ...")
    label: str = Field(description="Its name in messages.")
    factor: float = Field(gt=0, description="The factor by this ruler alone.")
    factor_ci95_low: float = Field(gt=0, description="Lower end of its 95 % interval.")
    factor_ci95_high: float = Field(gt=0, description="Upper end of its 95 % interval.")
    n: int = Field(ge=0, description="Number of things measured; a car in several photographs counts once.")
    p_right: float = Field(ge=0, le=1, description="Chance that it measured what it thinks, given all rulers.")


class ModelPhotograph(Record):
    """Photograph of a model, with the factor by its own rulers."""

    photograph: str = Field(description="Name of the photograph in the model.")
    status: Literal["used", "unclear", "outlier", "nothing", "error"] = Field(
        description="used: carries the factor. unclear: its own interval spans more than a factor of 2. outlier: its "
        "own interval and the model's do not meet. nothing: nothing of known size. error: not measured."
    )
    factor: float | None = Field(default=None, description="The factor by this photograph alone; null without one.")
    factor_ci95_low: float | None = Field(default=None, description="Lower end of its 95 % interval.")
    factor_ci95_high: float | None = Field(default=None, description="Upper end of its 95 % interval.")
    rulers: tuple[str, ...] = Field(default=(), description="Kinds of its rulers that found something.")
    n_vehicles: int = Field(
        default=0, ge=0, description="Cars that this photograph shows, also those that others show."
    )
    camera_height: float | None = Field(
        default=None, description="Height of the camera above its ground, units of the model."
    )
    tilt_deg: float | None = Field(
        default=None, description="Angle between the camera's axis and straight down, by the model."
    )
    error_code: str | None = Field(default=None, description="Stable code of the error; null without an error.")
    error: str | None = Field(default=None, description="The error and its remedy.")


class ModelScale(Record):
    """Factor that gives a reconstruction its size in metres."""

    status: Status = Field(description="ok: usable. low_confidence: use another source. no_scale: nothing found.")
    source: ModelSource = Field(description="Format of the model.")
    factor: float | None = Field(
        description="Metres per unit of the model: multiply its lengths by it; null if nothing of known size is found."
    )
    factor_ci95_low: float | None = Field(description="Lower end of its 95 % interval.")
    factor_ci95_high: float | None = Field(description="Upper end of its 95 % interval.")
    confidence: float = Field(ge=0, le=1, description="Chance of an error below 20 %.")
    reason: Reason | None = Field(description="Why the factor is not usable; null if it is.")
    verdict: str = Field(description="The result in one sentence.")
    n_photographs: int = Field(ge=0, description="Photographs of the model.")
    n_vehicles: int = Field(ge=0, description="Distinct cars behind the factor.")
    rulers: tuple[ModelRuler, ...] = Field(description="The rulers and their shares.")
    photographs: tuple[ModelPhotograph, ...] = Field(
        default=(), description="The photographs, in the order of the model."
    )
    model: str = Field(description="Name of the detector.")
    model_sha256: str = Field(description="SHA-256 of the detector's file.")
    warnings: tuple[Notice, ...] = Field(description="Further facts, each with a stable code.")
    schema_version: SchemaVersion = SCHEMA_VERSION
