"""Options of callers, in small frozen groups."""

from __future__ import annotations

from vehanchor.options.method import Effort, Lengths, Reference, Search
from vehanchor.options.reading import DECODED_BYTES_PER_PIXEL, Coordinates, Frame, ImageLimits, Reading
from vehanchor.options.rulers import AddedVehicle, Basis, ByHand, KnownLength, Rulers
from vehanchor.options.scale_options import DeclaredOption, ScaleOptions, declared_options

__all__ = [
    "DECODED_BYTES_PER_PIXEL",
    "AddedVehicle",
    "Basis",
    "ByHand",
    "Coordinates",
    "DeclaredOption",
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
