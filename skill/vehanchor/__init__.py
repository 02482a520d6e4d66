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
from typing import TYPE_CHECKING, Any

from vehanchor.errors import VehAnchorError

if TYPE_CHECKING:
    from vehanchor.analysis.measured import AreaAnalysis, DistanceAnalysis
    from vehanchor.analysis.scale import ScaleAnalysis
    from vehanchor.engine import Cancellation, Detector, Engine, Runtime, Segmenter
    from vehanchor.engine.verbs import (
        analyse_area,
        analyse_distance,
        analyse_scale,
        estimate_gsd,
        measure_area,
        measure_distance,
    )
    from vehanchor.imagery.sources.files import find_images
    from vehanchor.options import Frame, ImageLimits, Lengths, Reading, Reference, Rulers, ScaleOptions, Search
    from vehanchor.records import AreaMeasurement, DistanceMeasurement, GsdEstimate, KnownScale
    from vehanchor.scale.calibration import Calibration, load_calibration

    __version__: str

_LAZY = {  # resolved on first use, so that importing vehanchor costs nothing until it is used
    "analysis.measured": ("AreaAnalysis", "DistanceAnalysis"),
    "analysis.scale": ("ScaleAnalysis",),
    "imagery.sources.files": ("find_images",),
    "engine": ("Cancellation", "Detector", "Engine", "Runtime", "Segmenter"),
    "options": ("Frame", "ImageLimits", "Lengths", "Reading", "Reference", "Rulers", "ScaleOptions", "Search"),
    "records": ("AreaMeasurement", "DistanceMeasurement", "GsdEstimate", "KnownScale"),
    "scale.calibration": ("Calibration", "load_calibration"),
    "engine.verbs": (
        "analyse_area",
        "analyse_distance",
        "analyse_scale",
        "estimate_gsd",
        "measure_area",
        "measure_distance",
    ),
}
_HOME = {name: module for module, names in _LAZY.items() for name in names}

__all__ = [
    "AreaAnalysis",
    "AreaMeasurement",
    "Calibration",
    "Cancellation",
    "Detector",
    "DistanceAnalysis",
    "DistanceMeasurement",
    "Engine",
    "Frame",
    "GsdEstimate",
    "ImageLimits",
    "KnownScale",
    "Lengths",
    "Reading",
    "Reference",
    "Rulers",
    "Runtime",
    "ScaleAnalysis",
    "ScaleOptions",
    "Search",
    "Segmenter",
    "VehAnchorError",
    "__version__",
    "analyse_area",
    "analyse_distance",
    "analyse_scale",
    "estimate_gsd",
    "find_images",
    "load_calibration",
    "measure_area",
    "measure_distance",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("vehanchor")  # alone costs more than all the rest
    if name in _HOME:
        return getattr(importlib.import_module(f"vehanchor.{_HOME[name]}"), name)
    raise AttributeError(f"module 'vehanchor' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
