"""Raster: an image that is read by windows as upright 8-bit RGB, whatever its stored form."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

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

if TYPE_CHECKING:
    from types import TracebackType

    from numpy.typing import NDArray

    from vehanchor.imagery.metadata.camera import CameraMetadata
    from vehanchor.imagery.metadata.georeference import Ground

# EXIF orientation -> (swap rows and columns, then flip up-down, flip left-right) that turns the
# stored image upright.
_ORIENTATIONS = {
    1: (False, False, False),
    2: (False, False, True),
    3: (False, True, True),
    4: (False, True, False),
    5: (True, False, False),
    6: (True, False, True),
    7: (True, True, True),
    8: (True, True, False),
}


@dataclass(frozen=True)
class Window:
    """Rectangle of pixels in the oriented frame; (x_px, y_px) is its top left pixel."""

    x_px: int
    y_px: int
    width_px: int
    height_px: int


class RasterNote(NamedTuple):
    """Notice about the image for its user: ``bands_selected`` or ``pixels_stretched``."""

    code: str
    message: str


class StoredPixels(NamedTuple):
    """Pixels as stored: ``[h, w, 3]`` RGB in one of ``bands.DTYPES``, and a mask of valid pixels (None: all)."""

    rgb: NDArray[Any]
    valid: NDArray[np.bool_] | None


class Raster(ABC):
    """Open image. Any thread may read, one at a time. Close it, or use it as a context manager.

    Attributes:
        width_px: width of the oriented frame.
        height_px: height of the oriented frame.
        source: the given path, or "bytes", "file", "array", "image", "dataset".
        georeference_gsd_m_per_px: GSD by the file's georeference; None without one.
        warnings: notices for the user.
        camera: camera metadata of the file; None if it has none or the source is no file.
        ground: georeference of the image; None without one.
        in_memory: whether all pixels are decoded.
        encoded: path or bytes of the file that is read by windows; None if unknown.
        known_id: result of ``vehanchor.imagery.identity.image_id``; empty before.
    """

    camera: CameraMetadata | None = None
    ground: Ground | None = None
    in_memory = False
    encoded: str | bytes | None = None
    known_id = ""

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
        swapped = _ORIENTATIONS[orientation][0]
        self.width_px = stored_height_px if swapped else stored_width_px
        self.height_px = stored_width_px if swapped else stored_height_px
        self.source = source
        self.georeference_gsd_m_per_px = georeference_gsd_m_per_px
        self.warnings = notes
        self._orientation = orientation
        self._stretch: Stretch | None = None
        self._no_data: float | None = None

    def read(self, window: Window | None = None) -> NDArray[np.uint8]:
        """Read a window, or the whole image: [h, w, 3] uint8 RGB, contiguous; pixels without data are black.

        The result can be a read-only view of the caller's array if no conversion was needed.

        Raises:
            InvalidParameterError: the window is empty or not inside the image.
            ImageDecodeError: the file is damaged in this window.
            ImageFormatError: the values in this window cannot be converted.
        """
        if window is None:
            window = Window(0, 0, width_px=self.width_px, height_px=self.height_px)
        elif not (
            0 <= window.x_px < window.x_px + window.width_px <= self.width_px
            and 0 <= window.y_px < window.y_px + window.height_px <= self.height_px
        ):
            raise InvalidParameterError(
                f"{window} is not inside the image of {self.width_px} x {self.height_px} px"
            )
        return self._to_rgb(
            self._read_stored(
                stored_window(
                    window, self.width_px, height_px=self.height_px, orientation=self._orientation
                )
            )
        )

    def _to_rgb(self, stored: StoredPixels) -> NDArray[np.uint8]:
        """Convert stored pixels to upright 8-bit RGB."""
        shown = stored.rgb if self._stretch is None else to_uint8(stored.rgb, self._stretch)
        if stored.valid is not None:
            shown[~stored.valid] = 0
        if self._no_data is not None:
            shown[(stored.rgb == self._no_data).all(axis=2)] = 0
        return np.ascontiguousarray(oriented(shown, self._orientation))

    def read_overview(self, window: Window, factor: int) -> NDArray[np.uint8] | None:  # noqa: ARG002 - for subclasses
        """Read a window of the reduced image from the file's overviews; None if it has none.

        Args:
            window: in pixels of the reduced image, which has ``width_px // factor`` x ``height_px
                // factor``.
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
        """Choose no-data value and stretch from a sample of stored values, ``[n, 3]``."""
        words = []
        empty = find_no_data(sample)
        if empty is not None:
            self._no_data, share = empty
            sample = sample[(sample != self._no_data).any(axis=1)]
            words.append(
                f"the value {self._no_data:g}, in {share * 100:.0f} % of the pixels, counts as "
                "no data"
            )
        self._stretch = choose_stretch(sample)
        if self._stretch is not None and self._stretch != UNIT_RANGE:
            low, high = self._stretch
            percentiles = f"percentiles {STRETCH_PERCENTILES[0]:g} and {STRETCH_PERCENTILES[1]:g}"
            words.append(
                f"{sample.dtype} values {low:g} to {high:g} ({percentiles}) become 0 to 255"
            )
        if words:
            self.warnings = (*self.warnings, RasterNote("pixels_stretched", "; ".join(words)))


def oriented(stored: NDArray[np.uint8], orientation: int) -> NDArray[np.uint8]:
    """Turn a stored image ``[h, w, 3]`` upright, as a view.

    Args:
        stored: pixels in the file's orientation.
        orientation: EXIF orientation, 1 to 8.
    """
    swap, up_down, left_right = _ORIENTATIONS[orientation]
    turned = stored.swapaxes(0, 1) if swap else stored
    return turned[:: -1 if up_down else 1, :: -1 if left_right else 1]


def stored_window(window: Window, width_px: int, height_px: int, orientation: int) -> Window:
    """Map a window of the oriented frame, ``width_px`` x ``height_px``, to the stored frame."""
    swap, up_down, left_right = _ORIENTATIONS[orientation]
    x = width_px - window.x_px - window.width_px if left_right else window.x_px
    y = height_px - window.y_px - window.height_px if up_down else window.y_px
    if swap:
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
