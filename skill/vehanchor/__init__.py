"""VehAnchor: metric scale for aerial images without metadata.

Cars are everywhere and about 5 m long: found as oriented boxes, the mode of their pixel lengths
gives metres per pixel, with a confidence that a planner can act on.

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
    from vehanchor.engine import Cancellation, Engine, Runtime
    from vehanchor.imagery.sources.files import find_images
    from vehanchor.options import ImageLimits, ScaleOptions
    from vehanchor.records import AreaMeasurement, DistanceMeasurement, GsdEstimate
    from vehanchor.scale.calibration import load_calibration

    __version__: str
    estimate_gsd = Engine().estimate
    analyse_scale = Engine().analyse_scale
    measure_area = Engine().measure_area
    analyse_area = Engine().analyse_area
    measure_distance = Engine().measure_distance
    analyse_distance = Engine().analyse_distance

__all__ = [
    "AreaMeasurement",
    "Cancellation",
    "DistanceMeasurement",
    "Engine",
    "GsdEstimate",
    "ImageLimits",
    "Runtime",
    "ScaleOptions",
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
_HOMES = {  # resolved on first use, so that importing vehanchor costs nothing until it is used
    "engine": ("Cancellation", "Engine", "Runtime"),
    "imagery.sources.files": ("find_images",),
    "options": ("ImageLimits", "ScaleOptions"),
    "records": ("AreaMeasurement", "DistanceMeasurement", "GsdEstimate"),
    "scale.calibration": ("load_calibration",),
}
_METHODS = {"estimate_gsd": "estimate"}  # the other functions have their method's name


def __getattr__(name: str) -> Any:
    if name == "__version__":
        # alone costs more than all the rest
        return importlib.import_module("importlib.metadata").version("vehanchor")
    if name not in __all__:
        raise AttributeError(f"module 'vehanchor' has no attribute {name!r}")
    for home, names in _HOMES.items():
        if name in names:
            return getattr(importlib.import_module(f"vehanchor.{home}"), name)
    # a method of an engine with the bundled models
    return getattr(__getattr__("Engine")(), _METHODS.get(name, name))


def __dir__() -> list[str]:
    return sorted(__all__)
