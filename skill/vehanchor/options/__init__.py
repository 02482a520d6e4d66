"""Options that callers choose, in small frozen groups."""

from __future__ import annotations

from vehanchor.options.groups import (
    DECODED_BYTES_PER_PIXEL,
    Coordinates,
    Frame,
    ImageLimits,
    Lengths,
    OptionKeywords,
    Reading,
    Reference,
    ScaleOptions,
)
from vehanchor.options.rulers import KnownLength, Rulers
from vehanchor.options.search import Effort, Search

__all__ = [
    "DECODED_BYTES_PER_PIXEL",
    "Coordinates",
    "Effort",
    "Frame",
    "ImageLimits",
    "KnownLength",
    "Lengths",
    "OptionKeywords",
    "Reading",
    "Reference",
    "Rulers",
    "ScaleOptions",
    "Search",
]
