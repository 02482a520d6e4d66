"""Options of callers, in small frozen groups."""

from __future__ import annotations

from vehanchor.options.by_hand import AddedVehicle, ByHand
from vehanchor.options.frame import Coordinates, Frame
from vehanchor.options.image_limits import DECODED_BYTES_PER_PIXEL, ImageLimits
from vehanchor.options.lengths import Lengths
from vehanchor.options.reading import Reading
from vehanchor.options.reference import Reference
from vehanchor.options.rulers import Basis, KnownLength, Rulers
from vehanchor.options.scale_options import DeclaredOption, ScaleOptions, declared_options
from vehanchor.options.search import Effort, Search

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
