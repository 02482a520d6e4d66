"""Raster: an image that is read by windows as upright 8-bit RGB, whatever its stored form."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias, TypeVar

import numpy as np

from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.stretch import (
    STRETCH_PERCENTILES,
    UNIT_RANGE,
    Stretch,
    choose_stretch,
    find_no_data,
    to_uint8,
)
from vehanchor.options.pixel_grid import MAX_ASPECT, PixelGrid, usable_aspect

if TYPE_CHECKING:
    from types import TracebackType

    from numpy.typing import NDArray

    from vehanchor.imagery.metadata.camera import CameraMetadata
    from vehanchor.imagery.metadata.georeference import Ground, GroundPixel

    RgbImage: TypeAlias = NDArray[np.uint8]
    """``[h, w, 3]`` RGB."""


_Value = TypeVar("_Value", bound=np.generic)


class _Turn(NamedTuple):
    """Change that turns a stored image upright: first the swap, then the flips.

    Attributes:
        swap: whether rows and columns are swapped.
        flip_rows: whether the top becomes the bottom.
        flip_columns: whether the left side becomes the right one.
    """

    swap: bool
    flip_rows: bool
    flip_columns: bool


_TURNS = {
    1: _Turn(swap=False, flip_rows=False, flip_columns=False),
    2: _Turn(swap=False, flip_rows=False, flip_columns=True),
    3: _Turn(swap=False, flip_rows=True, flip_columns=True),
    4: _Turn(swap=False, flip_rows=True, flip_columns=False),
    5: _Turn(swap=True, flip_rows=False, flip_columns=False),
    6: _Turn(swap=True, flip_rows=False, flip_columns=True),
    7: _Turn(swap=True, flip_rows=True, flip_columns=True),
    8: _Turn(swap=True, flip_rows=True, flip_columns=False),
}
"""Change that turns a stored image upright, by its EXIF orientation."""

_BACK = {6: 8, 8: 6}
"""Orientation that undoes another; the orientations that are not listed undo themselves."""


@dataclass(frozen=True)
class Window:
    """Rectangle of pixels in the oriented frame; (x_px, y_px) is its top left pixel."""

    x_px: int
    y_px: int
    width_px: int
    height_px: int


class RasterNote(NamedTuple):
    """Notice about the image for its user; its code is one of ``NoticeCode``."""

    code: str
    message: str


class StoredPixels(NamedTuple):
    """Pixels as stored.

    Attributes:
        rgb: ``[h, w, 3]`` in one of ``bands.DTYPES``.
        valid: ``[h, w]``, whether a pixel holds data; None if all do.
    """

    rgb: NDArray[Any]
    valid: NDArray[np.bool_] | None


class Raster(ABC):
    """Open image. Any thread may read, one at a time. Close it, or use it as a context manager.

    Attributes:
        width_px: width of the oriented frame.
        height_px: height of the oriented frame.
        source: the caller's path, or "bytes", "file", "array", "image", "dataset".
        georeference_gsd_m_per_px: GSD by the file's georeference; None without one.
        warnings: notices for the user.
        orientation: EXIF orientation of the stored pixels, which are turned upright; 1 if they are.
        camera: camera metadata of the file; None if it has none or the source is not a file.
        ground: georeference of the image; None without one.
        pixel_aspect: height of a pixel over its width, both on the ground, by the file; 1 for
            square pixels and without such a fact.
        density_aspect: the same by the density in the header, which is a hint; 1 without one.
        in_memory: whether all pixels are decoded.
        encoded: path or bytes of the file that is read by windows; None if unknown.
        cached_id: result of ``vehanchor.imagery.identity.image_id``; empty before.
        origin_px: column and row of its first pixel in the image that it is a part of.
    """

    orientation = 1
    camera: CameraMetadata | None = None
    ground: Ground | None = None
    pixel_aspect = 1.0
    density_aspect = 1.0
    in_memory = False
    encoded: str | bytes | None = None
    cached_id = ""
    origin_px = (0, 0)

    def __init__(
        self,
        source: str,
        stored_width_px: int,
        stored_height_px: int,
        *,
        orientation: int = 1,
        georeference_gsd_m_per_px: float | None = None,
        notes: tuple[RasterNote, ...] = (),
    ) -> None:
        self.width_px = stored_width_px
        self.height_px = stored_height_px
        if _TURNS[orientation].swap:
            self.width_px = stored_height_px
            self.height_px = stored_width_px
        self.source = source
        self.georeference_gsd_m_per_px = georeference_gsd_m_per_px
        self.warnings = notes
        self.orientation = orientation
        self._orientation = orientation
        self._stretch: Stretch | None = None
        self._no_data: float | None = None

    def read(self, window: Window | None = None) -> RgbImage:
        """Read a window, or the whole image; pixels without data are black.

        Returns:
            ``[h, w, 3]`` uint8 RGB, contiguous. It can be a read-only view of the caller's array if
            no conversion was needed.

        Raises:
            InvalidParameterError: the window is empty or not inside the image.
            ImageDecodeError: the file is damaged in this window.
            ImageFormatError: the values in this window cannot be converted.
        """
        window = self._checked(window)
        window_in_file = stored_window(
            window,
            self.width_px,
            height_px=self.height_px,
            orientation=self._orientation,
        )
        stored = self._read_stored(window_in_file)
        return self._to_rgb(stored)

    @property
    def part(self) -> Window:
        """Its place in the image that it is a part of."""
        left_px, top_px = self.origin_px
        return Window(left_px, top_px, width_px=self.width_px, height_px=self.height_px)

    def georeference(self, pixel: GroundPixel, ground: Ground) -> None:
        """Take the place of the image, and the size and shape of a pixel on the ground."""
        self.ground = ground
        if self.take_shape(pixel):
            self.georeference_gsd_m_per_px = pixel.gsd_m_per_px

    def take_shape(self, pixel: GroundPixel) -> bool:
        """Take the shape of a pixel on the ground, in any unit of length.

        Returns:
            Whether its picture can be brought to square pixels; otherwise a warning says so.
        """
        elongation = max(pixel.aspect, 1 / pixel.aspect)
        if pixel.is_upright and elongation <= MAX_ASPECT:
            self.pixel_aspect = usable_aspect(pixel.aspect)
            return True
        message = (
            "By its map coordinates, a pixel of the file is not a rectangle on the ground, or is "
            f"more than {MAX_ASPECT:g} times as long as wide: no single scale holds. Reproject the "
            "image to UTM, with square pixels."
        )
        self.warnings = (*self.warnings, RasterNote("stretched", message))
        return False

    @property
    def grid(self) -> PixelGrid:
        """Pixels of the file and square pixels, which are the same here."""
        return PixelGrid(self.width_px, self.height_px)

    @property
    def in_file(self) -> Raster:
        """The image in the file's pixels: this one, unless it brings them to square pixels."""
        return self

    def _checked(self, window: Window | None) -> Window:
        """Check a window; None is the whole image.

        Raises:
            InvalidParameterError: the window is empty or not inside the image.
        """
        if window is None:
            return Window(0, 0, width_px=self.width_px, height_px=self.height_px)
        if not self._contains(window):
            raise InvalidParameterError(
                f"{window} is not inside the image of {self.width_px} x {self.height_px} px"
            )
        return window

    def use_stored_pixels(self) -> None:
        """Read the pixels as they are stored from now on, and no longer upright."""
        if _TURNS[self.orientation].swap:
            width_px = self.width_px
            self.width_px = self.height_px
            self.height_px = width_px
        if self._orientation == self.orientation:
            self._orientation = 1
        else:
            # The decoder has turned the pixels already: turn them back.
            self._orientation = _BACK.get(self.orientation, self.orientation)
        self.orientation = 1

    def stored_size_px(self) -> tuple[int, int]:
        """Return width and height of the stored pixels."""
        if _TURNS[self.orientation].swap:
            return self.height_px, self.width_px
        return self.width_px, self.height_px

    def stored_point(self, x: float, y: float) -> tuple[float, float]:
        """Map a point of the oriented frame to the stored frame; both in pixels."""
        turn = _TURNS[self.orientation]
        if turn.flip_columns:
            x = self.width_px - x
        if turn.flip_rows:
            y = self.height_px - y
        if turn.swap:
            return y, x
        return x, y

    def is_nonzero(self) -> NDArray[np.bool_]:
        """Test which pixels ``[h, w]`` of the stored frame are not 0 in all bands, for a mask."""
        size = (self.width_px, self.height_px)
        if _TURNS[self._orientation].swap:
            size = (self.height_px, self.width_px)
        whole = Window(0, 0, width_px=size[0], height_px=size[1])
        stored = self._read_stored(whole)
        return np.asarray(stored.rgb.any(axis=2))

    def _contains(self, window: Window) -> bool:
        """Test whether a window has pixels and lies inside the image."""
        right_px = window.x_px + window.width_px
        bottom_px = window.y_px + window.height_px
        has_columns = 0 <= window.x_px < right_px <= self.width_px
        has_rows = 0 <= window.y_px < bottom_px <= self.height_px
        return has_columns and has_rows

    def _to_rgb(self, stored: StoredPixels) -> RgbImage:
        """Convert stored pixels to upright 8-bit RGB."""
        pixels = stored.rgb
        if self._stretch is not None:
            pixels = to_uint8(stored.rgb, self._stretch)
        # Sources give a mask only with pixels of their own, which may be overwritten.
        if stored.valid is not None:
            pixels[~stored.valid] = 0
        if self._no_data is not None:
            is_empty = (stored.rgb == self._no_data).all(axis=2)
            pixels[is_empty] = 0
        upright = oriented(pixels, self._orientation)
        return np.ascontiguousarray(upright)

    def read_overview(
        self,
        window: Window,  # noqa: ARG002
        factor: int,  # noqa: ARG002
    ) -> RgbImage | None:
        """Read a window of the reduced image from the file's overviews; None if it has none.

        Sources with overviews override this method.

        Args:
            window: in pixels of the reduced image, which has ``width_px // factor`` columns and
                ``height_px // factor`` rows.
            factor: reduction factor, 2 or more.
        """
        return None

    def close(self) -> None:  # noqa: B027 - most rasters hold nothing to close
        """Release the file."""

    def __enter__(self) -> Raster:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    @abstractmethod
    def _read_stored(self, window: Window) -> StoredPixels:
        """Read a window of the stored frame."""

    def _choose_stretch(self, sample: NDArray[Any]) -> None:
        """Choose no-data value and stretch from a sample of stored values, ``[n, 3]``.

        A warning states each choice, except the scaling of 0..1 to 0..255, and that nothing can be
        seen. Of uint8, only faint images are stretched.
        """
        clauses = []
        is_8_bit = sample.dtype == np.uint8
        no_data = None if is_8_bit else find_no_data(sample)
        if no_data is not None:
            self._no_data, share = no_data
            clauses.append(
                f"the value {self._no_data:g}, in {share * 100:.0f} % of the pixels, counts as "
                "no data"
            )
            has_data = (sample != self._no_data).any(axis=1)
            sample = sample[has_data]
        self._stretch = choose_stretch(sample)
        if self._stretch is not None and self._stretch != UNIT_RANGE:
            low, high = self._stretch
            low_percentile, high_percentile = STRETCH_PERCENTILES
            clauses.append(
                f"{sample.dtype} values {low:g} to {high:g} (percentiles {low_percentile:g} and "
                f"{high_percentile:g}) become 0 to 255"
            )
        if clauses:
            note = RasterNote("pixels_stretched", "; ".join(clauses))
            self.warnings = (*self.warnings, note)
        darkest = sample.min() if sample.size else 0
        brightest = sample.max() if sample.size else 0
        # One comparison at a time: np.isin takes several times the memory of the sample.
        n_extreme = np.count_nonzero(sample == darkest) + np.count_nonzero(sample == brightest)
        if darkest == brightest:
            self._warn_of_nothing(
                "All sampled pixels have one value, so that nothing can be seen: check that the "
                "file is complete and was exported with its picture."
            )
        elif n_extreme == sample.size:
            self._warn_of_nothing(
                "The image has two values only, such as black and white, so that hardly anything "
                "can be seen: give it with its grey levels or colours."
            )

    def _warn_of_nothing(self, message: str) -> None:
        """Warn that the picture shows nothing."""
        self.warnings = (*self.warnings, RasterNote("nothing_visible", message))


def oriented(stored: NDArray[_Value], orientation: int) -> NDArray[_Value]:
    """Turn a stored image ``[h, w, 3]`` or mask ``[h, w]`` upright, as a view.

    Args:
        stored: pixels in the file's orientation, ``[h, w, 3]``, or a mask ``[h, w]``.
        orientation: EXIF orientation, 1 to 8.
    """
    turn = _TURNS[orientation]
    pixels: Any = stored
    if turn.swap:
        pixels = pixels.swapaxes(0, 1)
    if turn.flip_rows:
        pixels = pixels[::-1]
    if turn.flip_columns:
        pixels = pixels[:, ::-1]
    upright: NDArray[_Value] = pixels
    return upright


def swaps_sides(orientation: int) -> bool:
    """Test whether an EXIF orientation swaps rows and columns."""
    return _TURNS[orientation].swap


def oriented_points(
    stored: NDArray[np.float64], orientation: int, *, width_px: int, height_px: int
) -> NDArray[np.float64]:
    """Map points ``[n, 2]`` of the stored frame to the oriented one, ``width_px`` x ``height_px``.

    The first pixel spans 0 to 1 in both frames.
    """
    turn = _TURNS[orientation]
    points = stored[:, ::-1].copy() if turn.swap else stored.copy()
    if turn.flip_rows:
        points[:, 1] = height_px - points[:, 1]
    if turn.flip_columns:
        points[:, 0] = width_px - points[:, 0]
    return points


def stored_window(window: Window, width_px: int, *, height_px: int, orientation: int) -> Window:
    """Map a window of the oriented frame, ``width_px`` x ``height_px``, to the stored frame."""
    # The turn is undone in the opposite order: first the flips, then the swap.
    turn = _TURNS[orientation]
    x = window.x_px
    y = window.y_px
    if turn.flip_columns:
        x = width_px - window.x_px - window.width_px
    if turn.flip_rows:
        y = height_px - window.y_px - window.height_px
    if turn.swap:
        return Window(y, x, width_px=window.height_px, height_px=window.width_px)
    return Window(x, y, width_px=window.width_px, height_px=window.height_px)


def outer_sides(window: Window, width_px: int, height_px: int) -> tuple[bool, bool, bool, bool]:
    """Test whether the left, top, right and bottom of a window lie on the border of its image."""
    return (
        window.x_px == 0,
        window.y_px == 0,
        window.x_px + window.width_px == width_px,
        window.y_px + window.height_px == height_px,
    )
