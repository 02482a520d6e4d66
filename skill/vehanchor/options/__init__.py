"""Options of callers, in small frozen groups."""

from __future__ import annotations

from vehanchor.options.method import Effort, Lengths, Reference, Search
from vehanchor.options.reading import Coordinates, Frame, ImageLimits, Reading
from vehanchor.options.rulers import Basis, ByHand, KnownLength, Rulers
from vehanchor.options.scale_options import ScaleOptions, declared_options

__all__ = [
    "Basis",
    "ByHand",
    "Coordinates",
    "Effort",
    "Frame",
    "ImageLimits",
    "KnownLength",
    "Lengths",
    "Reading",
    "Reference",
    "Rulers",
    "ScaleOptions",
    "Search",
    "declared_options",
]
