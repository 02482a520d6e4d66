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
    from vehanchor.detection.detector import Detections, Detector
    from vehanchor.estimate import ScaleAnalysis, ScaleOptions, analyse_scale, estimate_gsd
    from vehanchor.measure import AreaAnalysis, analyse_area, measure_area
    from vehanchor.options import ImageLimits
    from vehanchor.records import AreaMeasurement, GsdEstimate
    from vehanchor.scale.calibration import Calibration, load_calibration
    from vehanchor.segmentation.segmenter import Segmenter

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
    "Segmenter",
    "VehAnchorError",
    "__version__",
    "analyse_area",
    "analyse_scale",
    "estimate_gsd",
    "load_calibration",
    "measure_area",
]

__version__ = version("vehanchor")

_LAZY = {  # resolved on first use, so that importing vehanchor costs nothing until it is used
    "AreaAnalysis": "measure",
    "AreaMeasurement": "records",
    "Calibration": "scale.calibration",
    "Detections": "detection.detector",
    "Detector": "detection.detector",
    "GsdEstimate": "records",
    "ImageLimits": "options",
    "ScaleAnalysis": "estimate",
    "ScaleOptions": "estimate",
    "Segmenter": "segmentation.segmenter",
    "analyse_area": "measure",
    "analyse_scale": "estimate",
    "estimate_gsd": "estimate",
    "load_calibration": "scale.calibration",
    "measure_area": "measure",
}


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(importlib.import_module(f"vehanchor.{_LAZY[name]}"), name)
    raise AttributeError(f"module 'vehanchor' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
