"""The record of a distance."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from vehanchor.records.geometry import ImagePoint
from vehanchor.records.gsd_estimate import Status
from vehanchor.records.interop import line_geometry
from vehanchor.records.measurement import (
    EstimateField,
    ImageHeight,
    ImageWidth,
    MeasuredConfidence,
    MeasuredGsd,
    MeasuredVehicles,
    MeasuredWarnings,
    ScaleField,
    ScaleSourceField,
)
from vehanchor.records.record import SCHEMA_VERSION, Record, SchemaVersion


class DistanceMeasurement(Record):
    """Length of a line on the ground: its pixels times the scale."""

    status: Status = Field(
        description="ok. low_confidence: the scale is not usable. no_scale: no scale, so pixels only."
    )
    distance_m: float | None = Field(
        description="length_px times GSD, metres, along the ground plane for a tilted camera; null without a scale."
    )
    distance_ci95_low_m: float | None = Field(
        description="Lower end of its 95 % interval, from the scale and one pixel of error per point."
    )
    distance_ci95_high_m: float | None = Field(description="Upper end of its 95 % interval.")
    confidence: MeasuredConfidence
    gsd_m_per_px: MeasuredGsd
    n_vehicles: MeasuredVehicles
    scale_source: ScaleSourceField
    length_px: float = Field(gt=0, description="Length of the line, pixels of the full image.")
    path: tuple[ImagePoint, ...] = Field(description="Its points in order, pixels of the full image.")
    image_width_px: ImageWidth
    image_height_px: ImageHeight
    scale: ScaleField
    estimate: EstimateField
    warnings: MeasuredWarnings
    schema_version: SchemaVersion = SCHEMA_VERSION

    @property
    def __geo_interface__(self) -> dict[str, Any]:
        """Path as a GeoJSON LineString, for shapely, geopandas and fiona; pixels, y down."""
        return line_geometry(self.model_dump(mode="json", include={"path"})["path"])
