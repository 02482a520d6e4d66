"""The resized copy of the image that the caller works in: the option group ``Frame``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, TypeAlias, get_args

from vehanchor.errors import FrameError, InvalidParameterError
from vehanchor.options.option import Limits, Option, Words, check_fields, option

Coordinates: TypeAlias = Literal["pixels", "fraction", "per_mille"]
"""Units in which places in a picture are written."""

FRAME = Option("Size, pixels, of the resized copy that you see and point in.", metavar="W H")
FRAME_SIDE = Limits(1, 1_000_000, whole=True)
_SHARES: dict[Coordinates, int] = {"fraction": 1, "per_mille": 1000}  # how far they reach along either side


@dataclass(frozen=True)
class Frame:
    """The resized copy of the image that the caller works in, and how places in it are written.

    Attributes:
        width_px: its width; with the height, or neither.
        height_px: its height.
        coordinates: pixels of the image, or of that copy where one is named; fraction: 0 to 1 of either side;
            per_mille: 0 to 1000 of either side.

    Raises:
        InvalidParameterError: one without the other, or no whole number >= 1.
    """

    width_px: int | None = field(
        default=None, metadata=option("Its width, pixels.", FRAME_SIDE, keyword="frame_width_px", cli=False)
    )
    height_px: int | None = field(
        default=None, metadata=option("Its height, pixels.", FRAME_SIDE, keyword="frame_height_px", cli=False)
    )
    coordinates: Coordinates = field(
        default="pixels",
        metadata=option(
            "Units of points, boxes and lines: pixels (of image or frame), fraction (0 to 1), per_mille (0 to 1000).",
            Words(get_args(Coordinates)),
        ),
    )

    def __post_init__(self) -> None:
        if (self.width_px is None) != (self.height_px is None):
            raise InvalidParameterError("a frame needs both frame_width_px and frame_height_px")
        check_fields(self)

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height, pixels; None without a frame."""
        return None if self.width_px is None or self.height_px is None else (self.width_px, self.height_px)

    def extent(self, width_px: int, height_px: int) -> tuple[int, int]:
        """How far coordinates reach to the right and down, in their own units.

        Args:
            width_px: of the image.
            height_px: of the image.
        """
        share = _SHARES.get(self.coordinates)
        return (share, share) if share else self.size or (width_px, height_px)

    def check(self, width_px: int, height_px: int) -> None:
        """Refuse a frame whose aspect ratio is not the image's: it would be a crop, or another image.

        Raises:
            FrameError: more than a pixel of rounding lies between them.
        """
        if self.size is None:
            return
        width, height = self.size
        fitting = width * height_px / width_px
        slack = 1.0 + height_px / width_px  # one pixel of rounding in either side
        if abs(height - fitting) > slack:
            raise FrameError(
                f"the frame is {width} x {height} px, the image {width_px} x {height_px} "
                f"px: a copy of that width would be {round(fitting)} px high. Give the size of an uncropped copy"
            )
