"""Records of flights, running cameras and reconstructions."""

from __future__ import annotations

from typing import Literal, TypeAlias

from pydantic import Field

from vehanchor.records.gsd_estimate import GsdEstimate, KnownScale, Status
from vehanchor.records.notices import Notice
from vehanchor.records.record import CI95_HIGH, CI95_LOW, SCHEMA_VERSION, Record, SchemaVersion
from vehanchor.scale.defaults import Reason

ModelSource: TypeAlias = Literal["opensfm", "colmap_text", "colmap_binary"]
"""Format of a reconstruction's files."""


class FlightRuler(Record):
    """Ruler that supports a photograph's scale."""

    ruler: str = Field(description="Kind of the ruler: vehicles, camera, positions, ...")
    photograph: str = Field(description="The photograph where it was measured.")


class FlightPhotograph(Record):
    """Photograph of a flight: scale from all evidence of the flight, and its own estimate."""

    photograph: str = Field(description="The photograph, as the caller named it.")
    status: Status | Literal["error"] = Field(
        description="ok: right within 20 % in at least 9 of 10 such photographs. "
        "low_confidence: do not act on the scale. no_scale: no scale. error: unreadable."
    )
    gsd_m_per_px: float | None = Field(
        default=None, description="Metres per pixel of this photograph, by all evidence."
    )
    gsd_ci95_low_m_per_px: float | None = Field(default=None, description=CI95_LOW)
    gsd_ci95_high_m_per_px: float | None = Field(default=None, description=CI95_HIGH)
    confidence: float | None = Field(
        default=None, ge=0, le=1, description="Confidence in the scale; null if unreadable."
    )
    reason: Reason | None = Field(
        default=None, description="Why the scale is not usable; null for ok and for an error."
    )
    advice: str | None = Field(
        default=None,
        description="The problem and a remedy, one sentence; null for ok and for an error.",
    )
    sortie: int | None = Field(
        default=None,
        description="Number of its sortie: one camera, no pause of more than 20 minutes; null "
        "if unreadable.",
    )
    component: int | None = Field(
        default=None, description="Number of its component; null if unreadable."
    )
    supported_by: tuple[FlightRuler, ...] = Field(
        default=(),
        description="Rulers behind its scale: its own, then those of the photograph with the "
        "strongest.",
    )
    scale: KnownScale | None = Field(
        default=None,
        description="The scale to give back for measurements in this photograph; null without a "
        "scale.",
    )
    own: GsdEstimate | None = Field(
        default=None, description="The estimate from this photograph alone."
    )
    error_code: str | None = Field(
        default=None, description="Stable code of the error; null without an error."
    )
    error: str | None = Field(default=None, description="The error and its remedy.")


class FlightComponent(Record):
    """Photographs that are linked by a common scale or by overlaps, and share their evidence."""

    number: int = Field(ge=0, description="Its number, 0 for the largest component.")
    n_photographs: int = Field(ge=1, description="Number of its photographs.")
    reference: str = Field(description="The photograph whose pixels all evidence is converted to.")
    pooled: GsdEstimate = Field(
        description="Scale of the reference from all evidence of the component."
    )
    advice: str | None = Field(
        description="If that scale is not usable, the problem and a remedy; null for ok."
    )


class FlightLink(Record):
    """Overlap of two photographs, and the ratio of their scales."""

    first: str = Field(description="One photograph.")
    second: str = Field(description="The other photograph.")
    ratio: float = Field(gt=0, description="Metres per pixel of the first over the second.")
    ratio_log_sd: float = Field(ge=0, description="Standard deviation of its natural log.")
    n_matches: int = Field(
        ge=0,
        description="Number of matched points; 0 for a link by positions and heights in the "
        "metadata.",
    )
    dropped: str | None = Field(description="Why the link is not used; null for a used link.")


class FlightEstimate(Record):
    """Scales of the photographs of one flight, from their common evidence."""

    status: Status = Field(
        description="ok: all readable photographs have a usable scale. low_confidence: only some. "
        "no_scale: none has a scale."
    )
    same_scale: bool = Field(description="Whether the caller stated one scale for all photographs.")
    gsd_m_per_px: float | None = Field(
        description="With same_scale the common scale, metres per pixel; else null."
    )
    gsd_ci95_low_m_per_px: float | None = Field(description=CI95_LOW)
    gsd_ci95_high_m_per_px: float | None = Field(description=CI95_HIGH)
    confidence: float = Field(
        ge=0, le=1, description="Of that scale; else the lowest of all photographs."
    )
    n_vehicles: int = Field(ge=0, description="Number of vehicles behind the scales.")
    photographs: tuple[FlightPhotograph, ...] = Field(
        description="The photographs, in the order of the input."
    )
    components: tuple[FlightComponent, ...] = Field(
        description="The largest first; one with same_scale."
    )
    links: tuple[FlightLink, ...] = Field(
        description="Overlapping photographs; none with same_scale."
    )
    model: str = Field(description="Name of the detector.")
    model_sha256: str = Field(description="SHA-256 of the detector's file.")
    warnings: tuple[Notice, ...] = Field(
        description="Further facts about the flight, each with a stable code."
    )
    schema_version: SchemaVersion = SCHEMA_VERSION

    @property
    def pixels_per_meter(self) -> float | None:
        """Pixels per metre with same_scale; None without a common scale."""
        if self.gsd_m_per_px is None:
            return None
        return 1 / self.gsd_m_per_px


class LiveScale(Record):
    """Scale of one frame by all frames so far; advisory, and not for a flight controller."""

    frame: str = Field(description="The file of the frame.")
    at_s: float = Field(description="Time of the frame, seconds since the first.")
    status: Status = Field(
        description="ok: the chance of an error below 20 % is at least 0.9, and the last "
        "vehicles agree. low_confidence: the scale is a hint. no_scale: no vehicles, or none for "
        "too long."
    )
    gsd_m_per_px: float | None = Field(
        description="Metres per pixel of this frame; null without a scale."
    )
    gsd_ci95_low_m_per_px: float | None = Field(description=CI95_LOW)
    gsd_ci95_high_m_per_px: float | None = Field(description=CI95_HIGH)
    confidence: float = Field(ge=0, le=1, description="Chance of an error below 20 %.")
    reason: Reason | None = Field(
        description="Why the scale is not usable: of the searched window; null for ok."
    )
    n_vehicles: int = Field(
        ge=0, description="Number of vehicles in the searched window of this frame."
    )
    seen_s_ago: float | None = Field(description="Seconds since vehicles last confirmed the scale.")
    linked: bool = Field(description="Whether features link this frame to the one before.")
    n_skipped: int = Field(
        ge=0, description="Number of frames that newer ones replaced since the last record."
    )
    latency_s: float = Field(
        ge=0, description="Seconds from the arrival of the frame to this record."
    )
    image_width_px: int = Field(ge=1, description="Width of the frame.")
    image_height_px: int = Field(ge=1, description="Height of the frame.")
    schema_version: SchemaVersion = SCHEMA_VERSION


class ModelRuler(Record):
    """Ruler behind a model's size."""

    kind: str = Field(description="Kind of the ruler: vehicles, courts, known_length, ...")
    label: str = Field(description="Its name in messages.")
    factor: float = Field(gt=0, description="The factor by this ruler alone.")
    factor_ci95_low: float = Field(gt=0, description=CI95_LOW)
    factor_ci95_high: float = Field(gt=0, description=CI95_HIGH)
    n: int = Field(
        ge=0, description="Number of things measured; a car in several photographs counts once."
    )
    p_right: float = Field(
        ge=0,
        le=1,
        description="Chance that it measured what it is meant to measure, given all rulers.",
    )


class ModelPhotograph(Record):
    """Photograph of a model, with the factor by its own rulers."""

    photograph: str = Field(description="Name of the photograph in the model.")
    status: Literal["used", "unclear", "outlier", "nothing", "error"] = Field(
        description="used: carries the factor. unclear: its own interval spans more than a "
        "factor of 2. outlier: its own interval and the model's do not meet. nothing: nothing of "
        "known size. error: not measured."
    )
    factor: float | None = Field(
        default=None, description="The factor by this photograph alone; null without one."
    )
    factor_ci95_low: float | None = Field(default=None, description=CI95_LOW)
    factor_ci95_high: float | None = Field(default=None, description=CI95_HIGH)
    rulers: tuple[str, ...] = Field(
        default=(), description="Kinds of its rulers that found something."
    )
    n_vehicles: int = Field(
        default=0, ge=0, description="Cars that this photograph shows, also those that others show."
    )
    camera_height: float | None = Field(
        default=None, description="Height of the camera above its ground, units of the model."
    )
    tilt_deg: float | None = Field(
        default=None, description="Angle between the camera's axis and straight down, by the model."
    )
    error_code: str | None = Field(
        default=None, description="Stable code of the error; null without an error."
    )
    error: str | None = Field(default=None, description="The error and its remedy.")


class ModelScale(Record):
    """Factor that gives a reconstruction its size in metres."""

    status: Status = Field(
        description="ok: usable. low_confidence: use another source. no_scale: nothing found."
    )
    source: ModelSource = Field(description="Format of the model.")
    factor: float | None = Field(
        description="Metres per unit of the model: multiply its lengths by it; null if nothing "
        "of known size is found."
    )
    factor_ci95_low: float | None = Field(description=CI95_LOW)
    factor_ci95_high: float | None = Field(description=CI95_HIGH)
    confidence: float = Field(ge=0, le=1, description="Chance of an error below 20 %.")
    reason: Reason | None = Field(description="Why the factor is not usable; null if it is.")
    advice: str | None = Field(
        default=None, description="Why the factor is not usable, and what helps; null if it is."
    )
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
