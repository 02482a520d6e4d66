"""Options of reading images: limits, the caller's resized copy, and conversion of its coordinates."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

from pydantic import Field, InstanceOf

from vehanchor.errors import FrameError
from vehanchor.options.option import Flag, Limits, Option, group, in_order, set_frozen

if TYPE_CHECKING:
    from collections.abc import Sequence

_MIB = 1 << 20
DECODED_BYTES_PER_PIXEL = 10
"""Memory for decoding 8-bit RGB, with a reserve."""

_Count = Annotated[int, Limits(least=1, whole=True)]


@group(frozen=True)
class ImageLimits:
    """Limits on the cost of an image, checked before decoding.

    Attributes:
        max_bytes: encoded size of a file that is read whole.
        max_pixels: declared width x height of an image that is decoded whole. Larger TIFFs and all
            JPEG 2000 are read by windows.
        max_windowed_pixels: declared width x height of an image that is read by windows.
        max_decoded_bytes: memory for decoding: width x height x bands x depth of an image decoded
            whole, or of a strip or tile of one read by windows, and the decoder's own memory.

    Raises:
        InvalidParameterError: a limit is not a whole number >= 1.
    """

    max_bytes: _Count = 512 * _MIB
    max_pixels: _Count = 100_000_000
    max_windowed_pixels: _Count = 10_000_000_000
    max_decoded_bytes: _Count = 1 << 30


Coordinates: TypeAlias = Literal["pixels", "fraction", "per_mille"]
"""Units of coordinates."""

_Side = Annotated[int, Limits(1, 1_000_000, whole=True)]
# largest value along either side
_SHARES: dict[Coordinates, int] = {"fraction": 1, "per_mille": 1000}


@group(frozen=True)
class FrameSize:
    """Size of the resized copy in which the caller works.

    Attributes:
        width_px: width of the copy.
        height_px: height of the copy.
    """

    width_px: _Side
    height_px: _Side


@group(frozen=True)
class Frame:
    """The caller's resized copy of the image, and the units of its coordinates.

    Attributes:
        frame: width and height of the copy; None for the image itself.
        coordinates: pixels: of the copy, or of the image without a copy; fraction: 0 to 1 of either
            side; per_mille: 0 to 1000 of either side.

    Raises:
        InvalidParameterError: a side is not a whole number >= 1, or the units are unknown.
    """

    frame: Annotated[
        FrameSize | None,
        in_order("width_px", "height_px"),
        Option("Size of your resized copy.", metavar="W H", tools="all"),
        Field(examples=[{"width_px": 1024, "height_px": 768}]),
    ] = None
    coordinates: Annotated[
        Coordinates,
        Option(
            "Pixels (of image or frame), fraction (0 to 1), per_mille (0 to 1000).", tools="all"
        ),
    ] = "pixels"

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height of the copy, pixels; None without a copy."""
        return None if self.frame is None else (self.frame.width_px, self.frame.height_px)

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
                f"px: a copy of that width would be {round(fitting)} px high. Give the size of "
                "an uncropped copy"
            )


Place: TypeAlias = tuple[float, float]
"""x, y; the first pixel spans 0 to 1."""

_CUT_EDGE = 1.0  # tolerance of rounding, in pixels or thousandths of a side
_CUT_EDGE_SHARE = 1e-3
# long sides of images shown to language models
_SEEN_SIDES_PX = (768, 1024, 1092, 1280, 1536, 1568, 2000, 2048, 2576)
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
        """Largest coordinates to the right and down, in their own units."""
        share = _SHARES.get(self.frame.coordinates)
        return (share, share) if share else self.frame.size or (self.width_px, self.height_px)

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
        return all(
            -cut < at < side + cut
            for place in places
            for at, side in zip(place, self.extent, strict=True)
        )

    def in_image(self, x: float, y: float) -> Place:
        """Convert a place to pixels of the full image; clamp it to the image."""
        across, down = self.extent
        x = x * self.width_px / across
        y = y * self.height_px / down
        return min(max(x, 0.0), float(self.width_px)), min(max(y, 0.0), float(self.height_px))

    def other_reading(self, places: Sequence[Place]) -> str:
        """Suggest other coordinates for invalid places; empty without a suggestion."""
        if self.frame.coordinates != "pixels" or min(min(place) for place in places) < 0:
            return ""
        if len(places) > 1 and all(tuple(place) == tuple(places[0]) for place in places):
            return ""  # no length in any unit
        x = max(place[0] for place in places)
        y = max(place[1] for place in places)
        if max(x, y) <= 1:
            return (
                "; as fractions of the sides it would be valid: for fractions, set "
                'coordinates to "fraction"'
            )
        # a larger copy makes lengths smaller still
        if self.frame.size is not None or self.inside(places):
            return ""
        for side in _SEEN_SIDES_PX:
            factor = side / max(self.width_px, self.height_px)
            width = round(self.width_px * factor)
            height = round(self.height_px * factor)
            if factor > 1 and x <= width and y <= height:
                thousand = (
                    ', or set coordinates to "per_mille" if they go to 1000'
                    if max(x, y) <= _THOUSAND
                    else ""
                )
                return (
                    f"; in a copy of {width} x {height} px it would be valid: for a copy, give "
                    "its size as the frame"
                    f"{thousand}"
                )
        return ""


_MEGAPIXEL = 1_000_000
_Band = Annotated[int, Limits(least=1, whole=True)]


@group(frozen=True)
class Reading:
    """Options of reading an image.

    Attributes:
        bands: three 1-based bands for red, green, blue; None takes the first three.
        limits: limits on the cost of an image, checked before decoding.
        bgr: arrays have the order blue, green, red, as in OpenCV.
        max_megapixels: replaces the limits of pixels and of memory for decoding; None keeps them.

    Raises:
        InvalidParameterError: a number is invalid, or the bands are not three whole numbers >= 1.
    """

    bands: Annotated[
        tuple[_Band, _Band, _Band] | None,
        Option("Bands for red, green and blue, from 1. Default: the first three.", metavar="R G B"),
    ] = None
    limits: Annotated[
        InstanceOf[ImageLimits], Option("Limits on the cost of an image.", cli=False)
    ] = field(default_factory=ImageLimits)
    bgr: Annotated[
        Flag, Option("Arrays have the order blue, green, red, as in OpenCV.", cli=False)
    ] = False
    max_megapixels: Annotated[
        Annotated[float, Limits(above=0)] | None,
        Option("Decode images of up to this many megapixels whole. Default: 100.", metavar="MP"),
    ] = None

    def __post_init__(self) -> None:
        if self.max_megapixels is not None:
            pixels = max(1, round(self.max_megapixels * _MEGAPIXEL))
            memory = max(self.limits.max_decoded_bytes, DECODED_BYTES_PER_PIXEL * pixels)
            set_frozen(
                self, "limits", replace(self.limits, max_pixels=pixels, max_decoded_bytes=memory)
            )
