"""Records that callers get: frozen pydantic models, the single source of every schema."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from vehanchor.records.gsd_estimate import (
    ConfidenceTerms,
    EstimateDetails,
    ExpectedGain,
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
from vehanchor.records.notices import Notice
from vehanchor.records.record import SCHEMA_VERSION
from vehanchor.scale.defaults import Reason, Remedy

if TYPE_CHECKING:
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

__all__ = [
    "SCHEMA_VERSION",
    "AreaMeasurement",
    "BoundingBox",
    "ConfidenceTerms",
    "DistanceMeasurement",
    "EstimateDetails",
    "ExpectedGain",
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
    "Remedy",
    "RulerScale",
    "ScaleSource",
    "SceneScaleEstimate",
    "Status",
    "TiltEstimate",
    "VehiclesByHand",
]


def __getattr__(name: str) -> Any:
    # Records of measurements are built on first use: an estimate needs none.
    if name not in __all__:
        raise AttributeError(f"module 'vehanchor.records' has no attribute {name!r}")
    measurement = importlib.import_module("vehanchor.records.measurement")
    return getattr(measurement, name)
