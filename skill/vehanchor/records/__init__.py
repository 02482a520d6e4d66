"""Records that callers get: frozen pydantic models, the single source of every schema."""

from __future__ import annotations

from vehanchor.records.gsd_estimate import (
    ConfidenceTerms,
    EstimateDetails,
    FrameScale,
    GsdEstimate,
    KnownPlane,
    KnownScale,
    ReferenceSource,
    RulerScale,
    SceneScaleEstimate,
    Status,
    TiltEstimate,
    VehiclesByHand,
)
from vehanchor.records.measurement import (
    AreaMeasurement,
    BoundingBox,
    DistanceMeasurement,
    FrameArea,
    ImagePoint,
    OtherObject,
    OutlinePolygon,
    OutlineRing,
    ScaleSource,
)
from vehanchor.records.notices import Notice
from vehanchor.records.record import SCHEMA_VERSION
from vehanchor.scale.defaults import Reason

__all__ = [
    "SCHEMA_VERSION",
    "AreaMeasurement",
    "BoundingBox",
    "ConfidenceTerms",
    "DistanceMeasurement",
    "EstimateDetails",
    "FrameArea",
    "FrameScale",
    "GsdEstimate",
    "ImagePoint",
    "KnownPlane",
    "KnownScale",
    "Notice",
    "OtherObject",
    "OutlinePolygon",
    "OutlineRing",
    "Reason",
    "ReferenceSource",
    "RulerScale",
    "ScaleSource",
    "SceneScaleEstimate",
    "Status",
    "TiltEstimate",
    "VehiclesByHand",
]
