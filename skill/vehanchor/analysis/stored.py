"""Intermediate results that journals store."""

from __future__ import annotations

from typing import Any

from vehanchor.detection.detections import Detections, Looks, Objects
from vehanchor.detection.scene_scale import SceneScalePrior
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.imagery.raster import RasterNote
from vehanchor.records import Notice
from vehanchor.scale.posterior import Lack, Mark, Witness
from vehanchor.scale.reliability import Shared
from vehanchor.tilt.camera_tilt import CameraTilt

STORED_CLASSES: tuple[type[Any], ...] = (
    CameraMetadata,
    CameraTilt,
    Detections,
    ImageFacts,
    Lack,
    Looks,
    Mark,
    Notice,
    Objects,
    RasterNote,
    SceneScalePrior,
    Shared,
    Witness,
)
"""Classes that journals store."""
