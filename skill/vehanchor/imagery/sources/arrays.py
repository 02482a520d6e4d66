"""Images held in memory: the caller's array, or a decoded file."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from vehanchor.errors import ImageFormatError
from vehanchor.imagery.bands import check_dtype, check_finite, choose_bands, is_alpha, merge_bands
from vehanchor.imagery.limits import check_side, check_whole_size
from vehanchor.imagery.raster import Raster, StoredPixels, Window
from vehanchor.imagery.stretch import SAMPLE_PX

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.imagery.bands import BandChoice
    from vehanchor.options import ImageLimits

    IsValid: TypeAlias = NDArray[np.bool_]
    """``[h, w]`` whether a pixel holds data."""

# Step of the sample that shows whether an image of 8 bits is faint, from the sample of others.
_FAINT_STEP = 4


class ArrayRaster(Raster):
    """Image in memory, converted window by window to avoid a second copy.

    Args:
        pixels: ``[h, w]`` or ``[h, w, bands]``; neither copied nor changed.
        source: name of the image.
        bands: bands to use as red, green and blue.
        bgr: whether the first three bands are blue, green and red.
        orientation: EXIF orientation to apply.
        alpha: whether the last of two or four bands is alpha. If this is unknown, its values
            decide.
        valid: ``[h, w]``, whether a pixel holds data; None if all do.
        stretch: whether faint pixels, and those of more than 8 bits, are stretched. Pixels that
            another raster has read are not: it has stretched them, if they were faint.

    Raises:
        InvalidParameterError: ``bands`` names a missing band.
        ImageFormatError: the image cannot be measured.
    """

    in_memory = True

    def __init__(
        self,
        pixels: NDArray[Any],
        source: str,
        bands: BandChoice,
        *,
        bgr: bool = False,
        orientation: int = 1,
        alpha: bool = False,
        valid: IsValid | None = None,
        stretch: bool = True,
    ) -> None:
        pixels = _check_array(pixels)
        height, width, n_bands = pixels.shape
        channels, notes = choose_bands(n_bands, bands)
        super().__init__(source, width, height, orientation=orientation, notes=notes)
        self._channels: tuple[int, ...] = channels
        if bgr and n_bands >= 3:
            stored_order = (2, 1, 0, *range(3, n_bands))
            self._channels = tuple(stored_order[channel] for channel in channels)
        self._pixels = pixels
        self._valid = valid

        # Alpha and stretch depend on a sample of evenly spaced pixels, which bounds their cost.
        step = math.ceil(math.sqrt(width * height / SAMPLE_PX))
        self._alpha = self._find_alpha(pixels[::step, ::step], is_declared=alpha)
        for channel in sorted(set(self._channels)):
            check_finite(pixels[:, :, channel])
        if not stretch:
            return
        if pixels.dtype == np.uint8:
            # A coarser sample shows as well whether an image is faint.
            step *= _FAINT_STEP
        sample = self._visible_sample(step)
        self._choose_stretch(sample[:, list(self._channels)])

    def _visible_sample(self, step: int) -> NDArray[Any]:
        """Select the pixels ``[n, bands]`` with data of every ``step``-th row and column."""
        sample = self._pixels[::step, ::step]
        is_visible = np.ones(sample.shape[:2], np.bool_)
        if self._alpha is not None:
            is_visible = sample[..., self._alpha] != 0
        if self._valid is not None:
            is_visible &= self._valid[::step, ::step]
        return sample[is_visible]

    def _find_alpha(self, sample: NDArray[Any], *, is_declared: bool) -> int | None:
        """Find the alpha band: the last of two or four, unless the caller reads it as a colour.

        Args:
            sample: evenly spaced pixels, ``[h, w, bands]``.
            is_declared: whether the last band is known to be alpha; otherwise its values decide.

        Raises:
            ImageFormatError: all pixels are transparent.
        """
        n_bands = sample.shape[2]
        if n_bands not in (2, 4) or n_bands - 1 in self._channels:
            return None
        if not is_declared and not is_alpha(sample[..., -1]):
            return None
        if not self._pixels[..., -1].any():
            raise ImageFormatError(
                "all pixels are transparent: save the image without its alpha band"
            )
        return -1

    def _read_stored(self, window: Window) -> StoredPixels:
        rows = slice(window.y_px, window.y_px + window.height_px)
        columns = slice(window.x_px, window.x_px + window.width_px)
        part = self._pixels[rows, columns].view()
        # A view of the caller's array leaves this class; it must not be written.
        part.flags.writeable = False
        n_bands = part.shape[2]
        if self._valid is None and n_bands == 3 and self._channels == (0, 1, 2):
            return StoredPixels(part, None)
        # Most files: OpenCV swaps red and blue in one pass, but not of float64.
        if n_bands == 3 and self._channels == (2, 1, 0) and part.dtype != np.float64:
            rgb = cv2.cvtColor(part, cv2.COLOR_BGR2RGB)
            return StoredPixels(rgb, self._valid_part(rows, columns))
        valid = self._valid_part(rows, columns)
        if self._alpha is not None:
            is_opaque = part[..., self._alpha] != 0
            valid = is_opaque if valid is None else valid & is_opaque
        rgb = merge_bands([part[:, :, channel] for channel in self._channels])
        return StoredPixels(rgb, valid)

    def _valid_part(self, rows: slice, columns: slice) -> IsValid | None:
        """Cut a window out of the mask of valid pixels."""
        return None if self._valid is None else self._valid[rows, columns]


def without_mask(image: np.ma.MaskedArray[Any, Any]) -> tuple[NDArray[Any], IsValid]:
    """Separate a masked array into its pixels and the mask of valid ones.

    A pixel has no data only if all its bands are masked, as in files.

    Returns:
        The pixels, 0 where they are masked, and ``[h, w]`` whether they are valid.
    """
    is_masked: IsValid = np.ma.getmaskarray(image)
    if is_masked.ndim == 3:
        is_masked = np.asarray(is_masked.all(axis=2))
    return image.filled(0), ~is_masked


def check_array_size(pixels: NDArray[Any], limits: ImageLimits) -> None:
    """Check the caller's array against the limit of pixels of an image that is held whole.

    Raises:
        ImageTooLargeError: it has too many pixels.
    """
    if pixels.ndim >= 2:
        height, width = pixels.shape[:2]
        check_whole_size("array", width, height_px=height, limits=limits)


def _check_array(pixels: NDArray[Any]) -> NDArray[Any]:
    """Check an array.

    Returns:
        ``[h, w, bands]`` in one of ``bands.DTYPES``, without a copy if possible.

    Raises:
        ImageFormatError: the shape or the type of the pixels is unsupported.
    """
    pixels = np.asarray(pixels)
    if pixels.ndim == 2:
        pixels = pixels[:, :, np.newaxis]
    if pixels.ndim != 3 or pixels.shape[2] == 0:
        raise ImageFormatError(
            f"an image array must have the shape [h, w] or [h, w, bands], got {list(pixels.shape)}"
        )
    height, width, _ = pixels.shape
    hint = "; an array's bands come last" if height in (1, 3, 4) else ""
    check_side(width, height, hint)
    dtype = pixels.dtype.newbyteorder("=")
    if dtype == np.float16:
        dtype = np.dtype(np.float32)
    check_dtype(dtype)
    return pixels.astype(dtype, copy=False)
