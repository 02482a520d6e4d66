"""The record of one frame of a running camera."""

from __future__ import annotations

from pydantic import Field

from vehanchor.records.gsd_estimate import Status
from vehanchor.records.record import SCHEMA_VERSION, Record, SchemaVersion
from vehanchor.scale.defaults import Reason


class LiveScale(Record):
    """Scale of one frame by all frames so far; advisory, and no input for a flight controller's estimator."""

    frame: str = Field(description="The file of the frame.")
    at_s: float = Field(description="Time of the frame, seconds since the first.")
    status: Status = Field(
        description="ok: the chance of an error below 20 % is at least 0.9, and the last vehicles agree. "
        "low_confidence: the scale is a hint. no_scale: no vehicles, or none for too long."
    )
    gsd_m_per_px: float | None = Field(description="Metres per pixel of this frame; null without a scale.")
    gsd_ci95_low_m_per_px: float | None = Field(description="Lower end of its 95 % interval.")
    gsd_ci95_high_m_per_px: float | None = Field(description="Upper end of its 95 % interval.")
    confidence: float = Field(ge=0, le=1, description="Chance of an error below 20 %.")
    reason: Reason | None = Field(description="Why the scale is not usable: of the searched window; null for ok.")
    n_vehicles: int = Field(ge=0, description="Number of vehicles in the searched window of this frame.")
    seen_s_ago: float | None = Field(description="Seconds since vehicles last confirmed the scale.")
    linked: bool = Field(description="Whether features link this frame to the one before.")
    n_skipped: int = Field(ge=0, description="Number of frames that newer ones replaced since the last record.")
    latency_s: float = Field(ge=0, description="Seconds from the arrival of the frame to this record.")
    image_width_px: int = Field(ge=1, description="Width of the frame.")
    image_height_px: int = Field(ge=1, description="Height of the frame.")
    schema_version: SchemaVersion = SCHEMA_VERSION
