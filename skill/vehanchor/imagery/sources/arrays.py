"""Images held in memory: the caller's array, or a decoded file."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from vehanchor.errors import ImageFormatError
from vehanchor.imagery.bands import check_dtype, check_finite, choose_bands, is_alpha, merge_bands
from vehanchor.imagery.limits import check_side
from vehanchor.imagery.raster import Raster, StoredPixels, Window
from vehanchor.imagery.stretch import SAMPLE_PX

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.imagery.bands import BandChoice


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
    ) -> None:
        pixels = _check_array(pixels)
        height, width, n_bands = pixels.shape
        channels, notes = choose_bands(n_bands, bands)
        super().__init__(
            source,
            width,
            height,
            orientation=orientation,
            notes=notes,
        )
        stored = (2, 1, 0, 3) if bgr and n_bands >= 3 else tuple(range(n_bands))
        self._channels = tuple(stored[channel] for channel in channels)
        self._pixels = pixels
        step = math.ceil(math.sqrt(width * height / SAMPLE_PX))
        sample = pixels[::step, ::step]
        unused = n_bands in (2, 4) and n_bands - 1 not in self._channels
        self._alpha = -1 if unused and (alpha or is_alpha(sample[..., -1])) else None
        if self._alpha is not None and not pixels[..., -1].any():
            raise ImageFormatError(
                "all pixels are transparent: save the image without its alpha band"
            )
        if pixels.dtype != np.uint8:
            for channel in sorted(set(self._channels)):
                check_finite(pixels[:, :, channel])
            seen = (
                sample.reshape(-1, n_bands) if self._alpha is None else sample[sample[..., -1] != 0]
            )
            self._choose_stretch(seen[:, list(self._channels)])

    def _read_stored(self, window: Window) -> StoredPixels:
        part = self._pixels[
            window.y_px : window.y_px + window.height_px,
            window.x_px : window.x_px + window.width_px,
        ].view()
        part.flags.writeable = False
        if self._channels == (0, 1, 2) and part.shape[2] == 3:
            return StoredPixels(part, None)
        if self._channels == (2, 1, 0) and part.shape[2] == 3 and part.dtype != np.float64:
            # one pass, for most files
            return StoredPixels(cv2.cvtColor(part, cv2.COLOR_BGR2RGB), None)
        valid = None if self._alpha is None else part[..., self._alpha] != 0
        return StoredPixels(merge_bands([part[:, :, channel] for channel in self._channels]), valid)


def _check_array(pixels: NDArray[Any]) -> NDArray[Any]:
    """Check an array and give it as ``[h, w, bands]`` in one of ``bands.DTYPES``, without a copy if possible."""
    pixels = np.asarray(pixels)
    if pixels.ndim == 2:
        pixels = pixels[:, :, np.newaxis]
    if pixels.ndim != 3 or pixels.shape[2] == 0:
        raise ImageFormatError(
            f"an image array must have the shape [h, w] or [h, w, bands], got {list(pixels.shape)}"
        )
    hint = "; an array's bands come last" if pixels.shape[0] in (1, 3, 4) else ""
    check_side(pixels.shape[1], pixels.shape[0], hint)
    dtype = np.dtype(np.float32) if pixels.dtype == np.float16 else pixels.dtype.newbyteorder("=")
    check_dtype(dtype)
    return pixels.astype(dtype, copy=False)
