"""The record of a flight: scales of many photographs by the evidence of all of them."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from vehanchor.records.gsd_estimate import GsdEstimate, Status
from vehanchor.records.known_scale import KnownScale
from vehanchor.records.notices import Notice
from vehanchor.records.record import SCHEMA_VERSION, Record, SchemaVersion


class FlightRuler(Record):
    """A ruler that supports a photograph's scale, and the photographs that link it."""

    ruler: str = Field(description="Kind of the ruler: vehicles, camera, positions, ...")
    photograph: str = Field(description="The photograph in which it was measured; the photograph itself, or another.")
    through: tuple[str, ...] = Field(
        description="Photographs in between, each of which overlaps the next; empty for the photograph itself, for one "
        "that overlaps it, and with same_scale."
    )


class FlightPhotograph(Record):
    """One photograph of a flight: its scale by all evidence of the flight, and its own estimate."""

    photograph: str = Field(description="The photograph, as the caller named it.")
    status: Status | Literal["error"] = Field(
        description="ok: confidence >= 0.5. low_confidence: below 0.5. no_scale: no scale. error: it cannot be read."
    )
    gsd_m_per_px: float | None = Field(description="Metres per pixel of this photograph, by all evidence.")
    gsd_ci95_low_m_per_px: float | None = Field(description="Lower end of its 95 % interval.")
    gsd_ci95_high_m_per_px: float | None = Field(description="Upper end of its 95 % interval.")
    confidence: float | None = Field(ge=0, le=1, description="Confidence in it; null for one that cannot be read.")
    component: int | None = Field(
        description="Number of the component it belongs to; null for one that cannot be read."
    )
    supported_by: tuple[FlightRuler, ...] = Field(description="Rulers that support its scale, the strongest first.")
    scale: KnownScale | None = Field(
        description="The scale to give back for measurements in this photograph; null without one."
    )
    east_m: float | None = Field(description="Place of its centre, metres east (by overlaps: to the right).")
    north_m: float | None = Field(description="Metres north (overlaps: up).")
    placed_by: Literal["positions", "overlaps"] | None = Field(
        description="positions: from its metadata, relative to the first photograph that has any. overlaps: relative "
        "to the component's reference, and turned as it. Null: no place."
    )
    own: GsdEstimate | None = Field(description="The estimate from this photograph alone.")
    error_code: str | None = Field(description="Stable code of why it cannot be read.")
    error: str | None = Field(description="What was wrong and what to do.")


class FlightComponent(Record):
    """Photographs that are linked by one scale or by overlaps, and share their evidence."""

    number: int = Field(ge=0, description="Its number; the largest component is 0.")
    n_photographs: int = Field(ge=1, description="Its photographs.")
    reference: str = Field(description="The photograph in whose pixels the evidence is pooled.")
    pooled: GsdEstimate = Field(
        description="The estimate of that photograph's scale from all evidence of the component."
    )


class FlightLink(Record):
    """Two photographs that overlap, and the ratio of their scales."""

    first: str = Field(description="One photograph.")
    second: str = Field(description="The other.")
    ratio: float = Field(gt=0, description="Metres per pixel of the first over those of the second.")
    ratio_log_sd: float = Field(ge=0, description="Standard deviation of its natural log.")
    n_matches: int = Field(ge=0, description="Points on the ground that were found in both.")
    dropped: str | None = Field(description="Why the link is not used; null for a link that is used.")


class FlightEstimate(Record):
    """Scales of the photographs of one flight, by the evidence of all of them."""

    status: Status = Field(
        description="ok: every photograph that can be read has a scale with a confidence >= 0.5. low_confidence: not "
        "all of them. no_scale: none has a scale."
    )
    same_scale: bool = Field(description="Whether the caller said that all photographs are of one scale.")
    gsd_m_per_px: float | None = Field(description="With same_scale the one scale, metres per pixel; else null.")
    gsd_ci95_low_m_per_px: float | None = Field(description="Lower end of its 95 % interval.")
    gsd_ci95_high_m_per_px: float | None = Field(description="Upper end of its 95 % interval.")
    confidence: float = Field(ge=0, le=1, description="Of that scale; else the least of the photographs'.")
    n_vehicles: int = Field(ge=0, description="Vehicles that the scales were taken from.")
    photographs: tuple[FlightPhotograph, ...] = Field(description="In the order in which they were given.")
    components: tuple[FlightComponent, ...] = Field(description="The largest first; one with same_scale.")
    links: tuple[FlightLink, ...] = Field(description="Overlapping photographs; none with same_scale.")
    model: str = Field(description="Name of the detector.")
    model_sha256: str = Field(description="SHA-256 of the detector's file.")
    warnings: tuple[Notice, ...] = Field(description="Further facts about the flight, each with a stable code.")
    schema_version: SchemaVersion = SCHEMA_VERSION
