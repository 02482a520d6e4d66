"""Which stored values are shown as black and as white: how depths above 8 bits become 8-bit pictures."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vehanchor.errors import ImageFormatError

if TYPE_CHECKING:
    from numpy.typing import NDArray

STRETCH_PERCENTILES = (2.0, 98.0)
"""Percentiles of the whole image shown as 0 and 255, the cut that GIS viewers use. One range for all three bands:
colours keep their balance."""

SAMPLE_PX = 1 << 20
"""Pixels from which the percentiles are taken at most; smaller images give all of theirs."""


class Stretch(NamedTuple):
    """The stored values shown as 0 and 255."""

    low: float
    high: float


UNIT_RANGE = Stretch(0.0, 1.0)


def choose_stretch(sample: NDArray[Any]) -> Stretch | None:
    """Decide which values of an image become 0 and 255.

    Args:
        sample: values of the image, of any shape, finite.

    Returns:
        None where the values are shown as they are: uint8.

    Raises:
        ImageFormatError: floats too far apart to be scaled.
    """
    if sample.dtype == np.uint8:
        return None
    if sample.size == 0:  # no data anywhere: every choice shows black
        return UNIT_RANGE
    least, most = float(sample.min()), float(sample.max())
    if sample.dtype.kind == "f" and least >= 0 and most <= 1:
        return UNIT_RANGE
    # "nearest": no arithmetic between values, so that the largest floats do not overflow
    low, high = (float(value) for value in np.percentile(sample, STRETCH_PERCENTILES, method="nearest"))
    if low == high:
        low, high = least, most
    if low == high:
        high = low + max(1.0, abs(low))  # constant: all black
    if not math.isfinite(255 / (high - low)) or math.isinf(high - low):
        raise ImageFormatError(f"pixel values from {low:g} to {high:g} cannot be scaled; rescale the image to 0..1")
    return Stretch(low, high)


def to_uint8(pixels: NDArray[Any], stretch: Stretch | None) -> NDArray[np.uint8]:
    """Show stored values of any shape as 0..255; uint8 without a stretch is returned itself."""
    if stretch is None:
        return pixels
    if pixels.dtype == np.uint16:
        table = _scaled(np.arange(1 << 16, dtype=np.float64), stretch)
        shown: NDArray[np.uint8] = table[pixels]
        return shown
    return _scaled(pixels.astype(np.float64), stretch)


def _scaled(values: NDArray[np.float64], stretch: Stretch) -> NDArray[np.uint8]:
    """``low..high`` as 0..255; works in place on ``values``."""
    np.clip(values, stretch.low, stretch.high, out=values)
    values -= stretch.low
    values *= 255 / (stretch.high - stretch.low)
    return np.rint(values, out=values).astype(np.uint8)
