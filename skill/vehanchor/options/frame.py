"""The option group ``Frame``: the caller's resized copy of the image."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Literal, TypeAlias, get_args

from vehanchor.errors import FrameError, InvalidParameterError
from vehanchor.options.option import Limits, Option, Words, check_fields, option

Coordinates: TypeAlias = Literal["pixels", "fraction", "per_mille"]
"""Units of coordinates."""

FRAME = Option("Size of your resized copy.", metavar="W H", first=True)
FRAME_SIDE = Limits(1, 1_000_000, whole=True)
_SHARES: dict[Coordinates, int] = {"fraction": 1, "per_mille": 1000}  # largest value along either side


@dataclass(frozen=True)
class Frame:
    """The caller's resized copy of the image, and the units of its coordinates.

    Attributes:
        width_px: width of the copy; with the height, or neither.
        height_px: height of the copy.
        coordinates: pixels: of the copy, or of the image without a copy; fraction: 0 to 1 of either side; per_mille:
            0 to 1000 of either side.

    Raises:
        InvalidParameterError: only one side is given, or a side is not a whole number >= 1.
    """

    panel: ClassVar[str] = "Reading the image"

    width_px: int | None = field(
        default=None, metadata=option("Its width, pixels.", FRAME_SIDE, keyword="frame_width_px", cli=False)
    )
    height_px: int | None = field(
        default=None, metadata=option("Its height, pixels.", FRAME_SIDE, keyword="frame_height_px", cli=False)
    )
    coordinates: Coordinates = field(
        default="pixels",
        metadata=option(
            "Pixels (of image or frame), fraction (0 to 1), per_mille (0 to 1000).",
            Words(get_args(Coordinates)),
        ),
    )

    def __post_init__(self) -> None:
        if (self.width_px is None) != (self.height_px is None):
            raise InvalidParameterError("a frame needs both frame_width_px and frame_height_px")
        check_fields(self)

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height of the copy, pixels; None without a copy."""
        return None if self.width_px is None or self.height_px is None else (self.width_px, self.height_px)

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
