"""Conversion of a caller's coordinates to pixels of the full image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.options.frame import Frame

Place: TypeAlias = tuple[float, float]
"""x, y; the first pixel spans 0 to 1."""

_CUT_EDGE = 1.0  # tolerance of rounding, in pixels or thousandths of a side
_CUT_EDGE_SHARE = 1e-3
_SEEN_SIDES_PX = (768, 1024, 1092, 1280, 1536, 1568, 2000, 2048, 2576)  # long sides of images shown to language models
_THOUSAND = 1000


@dataclass(frozen=True)
class CoordinateFrame:
    """Coordinate frame of a caller over one image.

    Attributes:
        frame: size of the caller's resized copy, and its units.
        width_px: width of the full image.
        height_px: height of the full image.
    """

    frame: Frame
    width_px: int
    height_px: int

    @property
    def extent(self) -> tuple[int, int]:
        """Largest coordinates to the right and down."""
        return self.frame.extent(self.width_px, self.height_px)

    @property
    def unit_px(self) -> tuple[float, float]:
        """Size of the finest step of the caller's coordinates, in pixels of the full image, across and down.

        For fractions, the step is a pixel of the caller's copy.
        """
        across, down = self.frame.size or (self.width_px, self.height_px)
        if self.frame.coordinates == "per_mille":
            across, down = self.extent
        return self.width_px / across, self.height_px / down

    @property
    def name(self) -> str:
        """Name of the coordinate frame, for messages."""
        if self.frame.coordinates != "pixels":
            return f"image, whose coordinates go from 0 to {self.extent[0]}"
        return "{} x {} px {}".format(*self.extent, "frame" if self.frame.size else "image")

    def inside(self, places: Sequence[Place]) -> bool:
        """Tell whether all places are inside, within rounding."""
        cut = _CUT_EDGE_SHARE if self.frame.coordinates == "fraction" else _CUT_EDGE
        return all(-cut < at < side + cut for place in places for at, side in zip(place, self.extent, strict=True))

    def in_image(self, place: Place) -> Place:
        """Convert a place to pixels of the full image; clamp it to the image."""
        across, down = self.extent
        x, y = place[0] * self.width_px / across, place[1] * self.height_px / down
        return min(max(x, 0.0), float(self.width_px)), min(max(y, 0.0), float(self.height_px))

    def other_reading(self, places: Sequence[Place]) -> str:
        """Suggest other coordinates for invalid places; empty without a suggestion."""
        if self.frame.coordinates != "pixels" or min(min(place) for place in places) < 0:
            return ""
        if len(places) > 1 and all(tuple(place) == tuple(places[0]) for place in places):
            return ""  # no length in any unit
        x, y = max(place[0] for place in places), max(place[1] for place in places)
        if max(x, y) <= 1:
            return '; as fractions of the sides it would be valid: for fractions, set coordinates to "fraction"'
        if self.frame.size is not None or self.inside(places):  # a larger copy makes lengths smaller still
            return ""
        for side in _SEEN_SIDES_PX:
            factor = side / max(self.width_px, self.height_px)
            width, height = round(self.width_px * factor), round(self.height_px * factor)
            if factor > 1 and x <= width and y <= height:
                thousand = ', or set coordinates to "per_mille" if they go to 1000' if max(x, y) <= _THOUSAND else ""
                return (
                    f"; in a copy of {width} x {height} px it would be valid: for a copy, give its size as the frame"
                    f"{thousand}"
                )
        return ""
