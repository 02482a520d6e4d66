"""Scales from more than one photograph: flights pooled or linked, reconstructions, running cameras.

same scale: photographs -> views -> pooled evidence -> record
overlaps:   photographs -> features -> pairs -> links -> components -> pooled evidence of each
component -> record
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from vehanchor_flight.inputs import InputPhotograph
    from vehanchor_flight.records import FlightEstimate, LiveScale, ModelScale
    from vehanchor_flight.verbs import estimate_flight, live_scales, rescale
    from vehanchor_flight.video import sample_video

_HOMES = {  # resolved on first use, so that the commands' help is fast
    "inputs": ("InputPhotograph",),
    "records": ("FlightEstimate", "LiveScale", "ModelScale"),
    "verbs": ("estimate_flight", "live_scales", "rescale"),
    "video": ("sample_video",),
}

__all__ = [
    "FlightEstimate",
    "InputPhotograph",
    "LiveScale",
    "ModelScale",
    "estimate_flight",
    "live_scales",
    "rescale",
    "sample_video",
]


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            return getattr(importlib.import_module(f"vehanchor_flight.{home}"), name)
    raise AttributeError(f"module 'vehanchor_flight' has no attribute {name!r}")
