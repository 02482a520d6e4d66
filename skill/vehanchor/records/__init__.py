"""Records that callers get: frozen pydantic models, the single source of every schema."""

from __future__ import annotations

from vehanchor.records.area import AreaMeasurement, FrameArea, OtherObject
from vehanchor.records.distance import DistanceMeasurement
from vehanchor.records.geometry import BoundingBox, ImagePoint, OutlinePolygon, OutlineRing
from vehanchor.records.gsd_estimate import (
    ConfidenceTerms,
    EstimateDetails,
    FrameScale,
    GsdEstimate,
    ReferenceSource,
    RulerScale,
    SceneScaleEstimate,
    Status,
    TiltEstimate,
    VehiclesByHand,
)
from vehanchor.records.known_scale import KnownPlane, KnownScale
from vehanchor.records.measurement import ScaleSource
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
