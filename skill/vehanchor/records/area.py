"""The record of an area."""

from __future__ import annotations

from typing import Any

from pydantic import Field

from vehanchor.records.geometry import BoundingBox, ImagePoint, OutlinePolygon
from vehanchor.records.gsd_estimate import Status
from vehanchor.records.interop import outline_geometry
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


class FrameArea(Record):
    """Object in the caller's resized copy."""

    width_px: int = Field(gt=0, description="Width of the caller's copy of the image, pixels.")
    height_px: int = Field(gt=0, description="Height of the caller's copy of the image, pixels.")
    gsd_m_per_px: float | None = Field(description="Metres per pixel of that copy; null without a scale.")
    bounding_box: BoundingBox | None = Field(description="The object's box in pixels of that copy; null for no mask.")


class OtherObject(Record):
    """Another object that points may mean; its box is a prompt for it."""

    area_m2: float | None = Field(description="Its area, square metres; null without a scale.")
    mask_area_px: int = Field(gt=0, description="Pixels of its mask in the full image.")
    mask_score: float = Field(ge=0, le=1, description="The segmenter's estimate of its mask's IoU.")
    bounding_box: BoundingBox = Field(description="Its box, pixels of the full image.")


class AreaMeasurement(Record):
    """Area of one object: the pixels of its mask times the square of the scale."""

    status: Status = Field(
        description="ok. low_confidence: the scale is not usable, the mask's score is below the model's "
        "limit, or there is no mask. no_scale: no scale, so pixels only."
    )
    area_m2: float | None = Field(
        description="mask_area_px times GSD squared, square metres, summed over the ground plane for a tilted camera; "
        "null without a scale."
    )
    area_ci95_low_m2: float | None = Field(description="Lower end of its 95 % interval, from scale and mask.")
    area_ci95_high_m2: float | None = Field(description="Upper end of its 95 % interval.")
    confidence: MeasuredConfidence
    gsd_m_per_px: MeasuredGsd
    n_vehicles: MeasuredVehicles
    mode_length_px: float | None = Field(description="P_mode: modal vehicle length, pixels; null without an estimate.")
    scale_source: ScaleSourceField
    mask_area_px: int = Field(ge=0, description="N_px: pixels of the mask in the full image.")
    mask_score: float = Field(ge=0, le=1, description="The segmenter's estimate of the mask's IoU.")
    perimeter_m: float | None = Field(description="Length of the mask's outline with its holes, metres.")
    length_m: float | None = Field(description="Longer side of the smallest rotated rectangle, metres.")
    width_m: float | None = Field(description="Shorter side of that rectangle, metres.")
    inscribed_diameter_m: float | None = Field(
        description="Diameter of the largest circle inside the mask, metres, as for a landing site."
    )
    inscribed_diameter_ci95_low_m: float | None = Field(description="Lower end of its 95 % interval.")
    inscribed_diameter_ci95_high_m: float | None = Field(description="Upper end of its 95 % interval.")
    inscribed_center: ImagePoint | None = Field(
        description="Centre of that circle, pixels of the full image; null for no mask."
    )
    bounding_box: BoundingBox | None = Field(description="The mask's box, pixels of the full image; null for no mask.")
    alternatives: tuple[OtherObject, ...] = Field(
        default=(), description="Other objects that the points may mean, best score first; empty for a box."
    )
    outline: tuple[OutlinePolygon, ...] = Field(
        description="The mask's outline, largest piece first, simplified to 200 points at most: for drawing. Areas "
        "come from the mask itself."
    )
    image_width_px: ImageWidth
    image_height_px: ImageHeight
    frame: FrameArea | None = Field(description="The object in the caller's resized copy; null without a frame.")
    scale: ScaleField
    estimate: EstimateField
    segmenter: str = Field(description="Name of the segmenter.")
    segmenter_sha256: str = Field(description="SHA-256 of the segmenter's encoder file followed by its decoder file.")
    warnings: MeasuredWarnings
    schema_version: SchemaVersion = SCHEMA_VERSION

    @property
    def __geo_interface__(self) -> dict[str, Any]:
        """Outline as a GeoJSON MultiPolygon, for shapely, geopandas and fiona; pixels, y down."""
        return outline_geometry(self.model_dump(mode="json", include={"outline"})["outline"])
