"""VehAnchor: metric scale for aerial images without metadata.

Cars are everywhere and about 5 m long: found as oriented boxes, the mode of their pixel lengths gives metres per pixel,
with a confidence that a planner can act on.

    >>> import vehanchor
    >>> estimate = vehanchor.estimate_gsd("photo.jpg")  # doctest: +SKIP
    >>> estimate.gsd_m_per_px, estimate.confidence  # doctest: +SKIP
    (0.152, 0.91)
"""

from __future__ import annotations

import importlib
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from vehanchor.errors import VehAnchorError

if TYPE_CHECKING:
    from vehanchor.calibration import Calibration, load_calibration
    from vehanchor.detection import Detections, Detector
    from vehanchor.imagery import ImageLimits
    from vehanchor.measurement import AreaAnalysis, analyse_area, measure_area
    from vehanchor.perception import ScaleAnalysis, ScaleOptions, analyse_scale, estimate_gsd
    from vehanchor.records import AreaMeasurement, GsdEstimate
    from vehanchor.scene import Scene, render_scene
    from vehanchor.segmentation import Segmenter

__all__ = [
    "AreaAnalysis",
    "AreaMeasurement",
    "Calibration",
    "Detections",
    "Detector",
    "GsdEstimate",
    "ImageLimits",
    "ScaleAnalysis",
    "ScaleOptions",
    "Scene",
    "Segmenter",
    "VehAnchorError",
    "__version__",
    "analyse_area",
    "analyse_scale",
    "estimate_gsd",
    "load_calibration",
    "measure_area",
    "render_scene",
]

__version__ = version("vehanchor")

_LAZY = {  # resolved on first use, so that importing vehanchor costs nothing until it is used
    "AreaAnalysis": "measurement",
    "AreaMeasurement": "records",
    "Calibration": "calibration",
    "Detections": "detection",
    "Detector": "detection",
    "GsdEstimate": "records",
    "ImageLimits": "imagery",
    "ScaleAnalysis": "perception",
    "ScaleOptions": "perception",
    "Scene": "scene",
    "Segmenter": "segmentation",
    "analyse_area": "measurement",
    "analyse_scale": "perception",
    "estimate_gsd": "perception",
    "load_calibration": "calibration",
    "measure_area": "measurement",
    "render_scene": "scene",
}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(f"vehanchor.{_LAZY[name]}"), name)
    raise AttributeError(f"module 'vehanchor' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
