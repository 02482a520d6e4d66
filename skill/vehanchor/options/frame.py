"""The option group ``Frame``: the caller's resized copy of the image."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

from pydantic import BeforeValidator, Field

from vehanchor.errors import FrameError
from vehanchor.options.option import Limits, Option, group

Coordinates: TypeAlias = Literal["pixels", "fraction", "per_mille"]
"""Units of coordinates."""

_Side = Annotated[int, Limits(1, 1_000_000, whole=True)]
_SHARES: dict[Coordinates, int] = {"fraction": 1, "per_mille": 1000}  # largest value along either side


@group(frozen=True)
class FrameSize:
    """Size of the resized copy in which the caller works.

    Attributes:
        width_px: width of the copy.
        height_px: height of the copy.
    """

    width_px: _Side
    height_px: _Side


def _sides(value: Any) -> Any:
    """Read a width and a height."""
    parts = value.replace("x", " ").replace(",", " ").split() if isinstance(value, str) else value
    if isinstance(parts, Sequence) and len(parts) == 2:
        return {"width_px": parts[0], "height_px": parts[1]}
    return value


@group(frozen=True)
class Frame:
    """The caller's resized copy of the image, and the units of its coordinates.

    Attributes:
        frame: width and height of the copy; None for the image itself.
        coordinates: pixels: of the copy, or of the image without a copy; fraction: 0 to 1 of either side; per_mille:
            0 to 1000 of either side.

    Raises:
        InvalidParameterError: a side is not a whole number >= 1, or the units are unknown.
    """

    panel: ClassVar[str] = "Reading the image"

    frame: Annotated[
        FrameSize | None,
        BeforeValidator(_sides),
        Option("Size of your resized copy.", metavar="W H", tools="all"),
        Field(examples=[{"width_px": 1024, "height_px": 768}]),
    ] = None
    coordinates: Annotated[
        Coordinates, Option("Pixels (of image or frame), fraction (0 to 1), per_mille (0 to 1000).", tools="all")
    ] = "pixels"

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height of the copy, pixels; None without a copy."""
        return None if self.frame is None else (self.frame.width_px, self.frame.height_px)

    def extent(self, width_px: int, height_px: int) -> tuple[int, int]:
        """Give the largest coordinates to the right and down, in their own units.

        Args:
            width_px: width of the image.
            height_px: height of the image.
        """
        share = _SHARES.get(self.coordinates)
        return (share, share) if share else self.size or (width_px, height_px)

    def check(self, width_px: int, height_px: int) -> None:
        """Check that the frame has the aspect ratio of the image, and is not a crop or another image.

        Raises:
            FrameError: the sides differ by more than a pixel of rounding.
        """
        if self.size is None:
            return
        width, height = self.size
        fitting = width * height_px / width_px
        slack = 1.0 + height_px / width_px  # one pixel of rounding per side
        if abs(height - fitting) > slack:
            raise FrameError(
                f"the frame is {width} x {height} px, the image {width_px} x {height_px} "
                f"px: a copy of that width would be {round(fitting)} px high. Give the size of an uncropped copy"
            )
