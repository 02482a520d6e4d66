"""VehAnchor: metric scale for aerial images without metadata.

Cars are everywhere and about 5 m long. VehAnchor finds them as oriented boxes; the mode of their
pixel lengths gives metres per pixel, with a confidence on which a planner can act.

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
    measure_areas = Engine().measure_areas
    analyse_areas = Engine().analyse_areas
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
    "analyse_areas",
    "analyse_distance",
    "analyse_scale",
    "estimate_gsd",
    "find_images",
    "load_calibration",
    "measure_area",
    "measure_areas",
    "measure_distance",
]
# Modules are imported on first use, so that ``import vehanchor`` is fast.
_NAMES_BY_MODULE = {
    "engine": ("Cancellation", "Engine", "Runtime"),
    "imagery.sources.files": ("find_images",),
    "options": ("ImageLimits", "ScaleOptions"),
    "records": ("AreaMeasurement", "DistanceMeasurement", "GsdEstimate"),
    "scale.calibration": ("load_calibration",),
}
# The other functions of the package have the name of their method.
_METHODS = {"estimate_gsd": "estimate"}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        # importlib.metadata takes longer to import than everything else here.
        metadata = importlib.import_module("importlib.metadata")
        return metadata.version("vehanchor")
    if name not in __all__:
        raise AttributeError(f"module 'vehanchor' has no attribute {name!r}")
    for module_name, names in _NAMES_BY_MODULE.items():
        if name in names:
            module = importlib.import_module(f"vehanchor.{module_name}")
            return getattr(module, name)
    # All other names are methods of an engine with the bundled models.
    engine = __getattr__("Engine")()
    return getattr(engine, _METHODS.get(name, name))


def __dir__() -> list[str]:
    return sorted(__all__)
