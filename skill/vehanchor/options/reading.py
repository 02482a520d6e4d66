"""Options of reading images: limits, the caller's resized copy, and its coordinates."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

from pydantic import Field, InstanceOf

from vehanchor.errors import FrameError
from vehanchor.options.option import Flag, Limits, Option, group, in_order, set_frozen
from vehanchor.options.pixel_grid import PixelGrid

if TYPE_CHECKING:
    from collections.abc import Sequence

_MIB = 1 << 20
DECODED_BYTES_PER_PIXEL = 10
"""Bytes of memory per pixel for decoding 8-bit RGB, with a reserve."""

_Count = Annotated[int, Limits(least=1, whole=True)]


@group(frozen=True)
class ImageLimits:
    """Limits on the cost of an image, checked before decoding.

    Attributes:
        max_bytes: encoded size of a file that is read whole.
        max_pixels: declared width x height of an image that is decoded whole. Larger TIFFs and all
            JPEG 2000 files are read by windows.
        max_windowed_pixels: declared width x height of an image that is read by windows.
        max_decoded_bytes: memory for decoding: width x height x bands x depth of an image that is
            decoded whole, or of a strip or tile of one that is read by windows, and the decoder's
            own memory.

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
# Largest coordinate along either side, for units that do not depend on the size.
_LARGEST_SHARE: dict[Coordinates, int] = {"fraction": 1, "per_mille": 1000}


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
        coordinates: pixels: of the copy, or of the image without a copy; fraction: 0 to 1 along
            either side; per_mille: 0 to 1000 along either side.

    Raises:
        InvalidParameterError: a side is not a whole number >= 1, or the units are unknown.
    """

    frame: Annotated[
        FrameSize | None,
        in_order("width_px", "height_px"),
        Option(
            "Size of your resized copy of the image, if your coordinates are its pixels.",
            metavar="W H",
            tools="all",
        ),
        Field(examples=[{"width_px": 1024, "height_px": 768}]),
    ] = None
    coordinates: Annotated[
        Coordinates,
        Option(
            "Unit of your coordinates: pixels (of image or frame), fraction (0 to 1) or per_mille "
            "(0 to 1000).",
            tools="all",
        ),
    ] = "pixels"

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height of the copy, pixels; None without a copy."""
        if self.frame is None:
            return None
        return self.frame.width_px, self.frame.height_px

    def check(self, grid: PixelGrid) -> None:
        """Check that the frame has the aspect ratio of the image.

        A crop and a copy of another image usually have another one. A copy may have the pixels of
        the file or square ones.

        Raises:
            FrameError: the sides differ by more than a pixel of rounding.
        """
        if self.size is None:
            return
        in_square_pixels = (grid.square_width_px, grid.square_height_px)
        if self._is_copy_of(*in_square_pixels):
            return
        width_px = grid.width_px
        height_px = grid.height_px
        if self._is_copy_of(width_px, height_px):
            return
        width, height = self.size
        expected_height = width * height_px / width_px
        raise FrameError(
            f"the frame is {width} x {height} px, the image {width_px} x {height_px} px: a "
            f"copy of that width would be {round(expected_height)} px high. Give the size of "
            "an uncropped copy"
        )

    def _is_copy_of(self, width_px: int, height_px: int) -> bool:
        """Test whether the copy has the proportions of an image, within rounding."""
        if self.size is None:
            return False
        width, height = self.size
        expected_height = width * height_px / width_px
        # Either side of the copy may be rounded by one pixel.
        tolerance = 1.0 + height_px / width_px
        return abs(height - expected_height) <= tolerance


Place: TypeAlias = tuple[float, float]
"""x, y; the first pixel spans 0 to 1."""

# Callers round coordinates, so that a point on the border may lie just outside.
_EDGE_TOLERANCE = 1.0  # in pixels, or thousandths of a side
_EDGE_TOLERANCE_FRACTION = 1e-3
VIEWED_SIDE_PX = 1024
"""Usual long side of the picture of an image that the tool ``view_image`` shows. A choice."""

MAX_VIEW_ENLARGEMENT = 4.0
"""Largest enlargement of that picture; a larger one shows nothing more. A choice."""

_MAX_PER_MILLE = 1000


@dataclass(frozen=True)
class CoordinateFrame:
    """Coordinate frame of a caller over one image.

    Callers count pixels of the file; ``in_image`` gives square pixels.

    Attributes:
        frame: size of the caller's resized copy, and its units.
        grid: pixels of the full image, in its file and square.
    """

    frame: Frame
    grid: PixelGrid

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height of the caller's copy, or of the file without a copy, in pixels."""
        return self.frame.size or (self.grid.width_px, self.grid.height_px)

    @property
    def extent(self) -> tuple[int, int]:
        """Largest coordinates to the right and down, in the caller's units."""
        share = _LARGEST_SHARE.get(self.frame.coordinates)
        if share is not None:
            return share, share
        return self.size_px

    @property
    def unit_px(self) -> tuple[float, float]:
        """Size of one step of the caller's coordinates across and down, in square pixels.

        For fractions, the step is a pixel of the caller's copy.
        """
        if self.frame.coordinates == "per_mille":
            steps_across, steps_down = self.extent
            width_px = self.grid.square_width_px
            height_px = self.grid.square_height_px
            return width_px / steps_across, height_px / steps_down
        return self.unit_of_copy_px

    @property
    def side_of_copy_px(self) -> float:
        """Shorter side of a pixel of the caller's copy, or of the file, in square pixels."""
        across, down = self.unit_of_copy_px
        # Proportions of square pixels differ by the rounding of the copy's sides alone.
        return across if self.grid.is_square else min(across, down)

    @property
    def unit_of_copy_px(self) -> tuple[float, float]:
        """Sides of a pixel of the caller's copy, or of the file, in square pixels: across, down."""
        width, height = self.size_px
        return self.grid.square_width_px / width, self.grid.square_height_px / height

    @property
    def name(self) -> str:
        """Name of the coordinate frame, for messages."""
        width, height = self.extent
        if self.frame.coordinates != "pixels":
            return f"image, whose coordinates go from 0 to {width}"
        noun = "image" if self.frame.size is None else "frame"
        return f"{width} x {height} px {noun}"

    def inside(self, places: Sequence[Place]) -> bool:
        """Test whether all places are inside, within rounding."""
        tolerance = _EDGE_TOLERANCE
        if self.frame.coordinates == "fraction":
            tolerance = _EDGE_TOLERANCE_FRACTION
        x_limit, y_limit = self.extent
        for x, y in places:
            x_inside = -tolerance < x < x_limit + tolerance
            y_inside = -tolerance < y < y_limit + tolerance
            if not (x_inside and y_inside):
                return False
        return True

    def in_image(self, x: float, y: float) -> Place:
        """Convert a place to square pixels of the full image; clamp it to the image."""
        across, down = self.extent
        width_px = self.grid.square_width_px
        height_px = self.grid.square_height_px
        x_px = x * width_px / across
        y_px = y * height_px / down
        return _clamp(x_px, width_px), _clamp(y_px, height_px)

    def other_reading(self, places: Sequence[Place]) -> str:
        """Suggest other coordinates for invalid places; empty without a suggestion."""
        if self.frame.coordinates != "pixels":
            return ""
        if any(min(place) < 0 for place in places):
            return ""
        first = tuple(places[0])
        if len(places) > 1 and all(tuple(place) == first for place in places):
            return ""  # Equal places have no length in any unit.
        x_max = max(place[0] for place in places)
        y_max = max(place[1] for place in places)
        if max(x_max, y_max) <= 1:
            return (
                "; as fractions of the sides it would be valid: for fractions, set "
                'coordinates to "fraction"'
            )
        # The caller may have read the place in an enlarged picture. No other size is suggested: a
        # place that fits some copy would pass, and measure something else. A place inside the
        # image needs no copy, because a larger one only makes lengths smaller.
        if self.frame.size is not None or self.inside(places):
            return ""
        width, height = self._viewed_size()
        if width <= self.grid.width_px or x_max > width or y_max > height:
            return ""
        suggestion = (
            f"; if you read it in the picture of {width} x {height} px from view_image, give that "
            "size as the frame"
        )
        if max(x_max, y_max) <= _MAX_PER_MILLE:
            suggestion += '; if your coordinates go to 1000, set coordinates to "per_mille"'
        return suggestion

    def _viewed_size(self) -> tuple[int, int]:
        """Compute the width and height of the picture that ``view_image`` shows of the image."""
        width_px = self.grid.square_width_px
        height_px = self.grid.square_height_px
        factor = min(VIEWED_SIDE_PX / max(width_px, height_px), MAX_VIEW_ENLARGEMENT)
        return round(width_px * factor), round(height_px * factor)


def _clamp(coordinate: float, side_px: int) -> float:
    return min(max(coordinate, 0.0), float(side_px))


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
        if self.max_megapixels is None:
            return
        pixels = max(1, round(self.max_megapixels * _MEGAPIXEL))
        memory = max(self.limits.max_decoded_bytes, DECODED_BYTES_PER_PIXEL * pixels)
        limits = replace(self.limits, max_pixels=pixels, max_decoded_bytes=memory)
        set_frozen(self, "limits", limits)
