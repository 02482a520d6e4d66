"""Classes of intermediate results that journals store, and their names in earlier journals."""

from __future__ import annotations

from typing import Any

from vehanchor.detection.detections import Appearance, Detections, Objects
from vehanchor.detection.scene_scale import SceneScalePrior
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.imagery.raster import RasterNote
from vehanchor.options.pixel_grid import PixelGrid
from vehanchor.records import Notice
from vehanchor.rulers.camera_tilt import CameraTilt
from vehanchor.scale.posterior import Lack, Mark, Witness
from vehanchor.scale.reliability import Shared

STORED_CLASSES: tuple[type[Any], ...] = (
    CameraMetadata,
    CameraTilt,
    Detections,
    ImageFacts,
    Lack,
    Appearance,
    Mark,
    Notice,
    Objects,
    PixelGrid,
    RasterNote,
    SceneScalePrior,
    Shared,
    Witness,
)
"""Classes that journals store."""

FORMER_NAMES = {
    "Looks": "Appearance",
    "Detections.looks": "appearance",
    "Detections.scales": "reductions",
    "Witness.said": "statement",
    "StoredPhotograph.resolved": "detail_share",
}
"""Today's names by former names: of a class, or of a field as ``Class.field``."""
