"""Names under which journals store intermediate results; they outlive the names of classes and modules."""

from __future__ import annotations

from typing import Any

from vehanchor.detection.detections import Detections, Looks, Objects
from vehanchor.detection.scene_scale import SceneScalePrior
from vehanchor.imagery.facts import ImageFacts
from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.imagery.raster import RasterNote
from vehanchor.records import Notice
from vehanchor.scale.lengths import Interval
from vehanchor.scale.posterior import Lack, Mark, Witness
from vehanchor.scale.reliability import Shared
from vehanchor.tilt.camera_tilt import CameraTilt

STORED_CLASSES: dict[str, type[Any]] = {
    "camera_metadata": CameraMetadata,
    "camera_tilt": CameraTilt,
    "detections": Detections,
    "shared": Shared,
    "witness": Witness,
    "lack": Lack,
    "looks": Looks,
    "image_facts": ImageFacts,
    "interval": Interval,
    "mark": Mark,
    "notice": Notice,
    "objects": Objects,
    "raster_note": RasterNote,
    "scene_scale_prior": SceneScalePrior,
}
"""Classes of intermediate results by their stored names."""
