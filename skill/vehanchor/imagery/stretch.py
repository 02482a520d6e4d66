"""Contrast stretch: conversion of stored values above 8 bits to 8-bit images."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vehanchor.errors import ImageFormatError

if TYPE_CHECKING:
    from numpy.typing import NDArray

STRETCH_PERCENTILES = (2.0, 98.0)
"""Percentiles of the whole image that become 0 and 255, as in GIS viewers.

All three bands share one range, which keeps the colour balance.
"""

SAMPLE_PX = 1 << 20
"""Maximum number of pixels in the sample for the percentiles; smaller images are used whole."""


class Stretch(NamedTuple):
    """Stored values that become 0 and 255."""

    low: float
    high: float


UNIT_RANGE = Stretch(0.0, 1.0)
"""Stretch of floats within 0..1."""

FAINT_LEVELS = 24
"""Number of the 256 grey levels up to which an image is faint: little can be seen without a
stretch. A choice."""

_FAINT_PERCENTILES = {"u": (0.1, 99.9), "f": STRETCH_PERCENTILES}
"""Percentiles between which the values of a faint image lie, by the kind of the values.

An image of 8 bits was made to be looked at, so that only single pixels may be brighter. Floats are
often reflectances, with glints of the sun.
"""

_MIN_EMPTY_SHARE = 1 - STRETCH_PERCENTILES[1] / 100
"""Share of the pixels above which an extreme value reaches the percentiles."""


def find_no_data(sample: NDArray[Any]) -> tuple[float, float] | None:
    """Find a value that stands for "no data" without being declared.

    Examples are -9999, or 65535 beside values of 12 bits.

    Args:
        sample: finite values of the image, ``[n, bands]``.

    Returns:
        The lowest or highest value and its share of the pixels, or None. It must fill all bands of
        2 % of the pixels, and its distance from all other values must exceed their whole range.
        Clipped highlights fail the second test, because they are next to other values.
    """
    if sample.size == 0:
        return None
    for extreme in (sample.min(), sample.max()):
        is_extreme = (sample == extreme).all(axis=1)
        share = is_extreme.mean()
        if not _MIN_EMPTY_SHARE < share < 1:
            continue
        others = sample[~is_extreme]
        lowest = float(others.min())
        highest = float(others.max())
        value = float(extreme)
        gap = max(lowest - value, value - highest)
        if gap > highest - lowest > 0:
            return value, float(share)
    return None


def is_faint(sample: NDArray[Any], full_range: float) -> bool:
    """Test whether an image uses so few grey levels that little can be seen.

    Args:
        sample: values of the image, of any shape.
        full_range: difference of the values that become black and white.

    Returns:
        False for a constant image, in which a stretch shows nothing.
    """
    if sample.size == 0:
        return False
    shares = _FAINT_PERCENTILES[sample.dtype.kind]
    percentiles = np.percentile(sample, shares, method="nearest")
    value_range = float(percentiles[1]) - float(percentiles[0])
    return 0.0 < value_range <= full_range * FAINT_LEVELS / 255


def choose_stretch(sample: NDArray[Any]) -> Stretch | None:
    """Choose the values of an image that become 0 and 255.

    Args:
        sample: finite values of the image, of any shape.

    Returns:
        The stretch; None for uint8, unless the image is faint.

    Raises:
        ImageFormatError: the range of the floats is too large to scale.
    """
    if sample.dtype == np.uint8 and not is_faint(sample, 255.0):
        return None
    if sample.size == 0:  # no data: every stretch gives black
        return UNIT_RANGE
    lowest = float(sample.min())
    highest = float(sample.max())
    is_unit = sample.dtype.kind == "f" and lowest >= 0 and highest <= 1
    if is_unit and not is_faint(sample, 1.0):
        return UNIT_RANGE
    # "nearest" does no arithmetic between values, so the largest floats do not overflow.
    percentiles = np.percentile(sample, STRETCH_PERCENTILES, method="nearest")
    low = float(percentiles[0])
    high = float(percentiles[1])
    # Nearly all pixels are equal: the few others, such as one bright pixel, span the range.
    if low == high:
        low = lowest
        high = highest
    if low == high:
        high = low + max(1.0, abs(low))  # constant: all black
    value_range = high - low
    if math.isinf(value_range) or not math.isfinite(255 / value_range):
        raise ImageFormatError(
            f"pixel values from {low:g} to {high:g} cannot be scaled; rescale the image to 0..1"
        )
    return Stretch(low, high)


def to_uint8(pixels: NDArray[Any], stretch: Stretch) -> NDArray[np.uint8]:
    """Convert stored values of any shape to 0..255."""
    if pixels.dtype in (np.uint8, np.uint16):
        # A look-up table of all values costs less than arithmetic on every pixel.
        n_values = 1 << (8 * pixels.dtype.itemsize)
        all_values = np.arange(n_values, dtype=np.float64)
        table = _scale_in_place(all_values, stretch)
        scaled: NDArray[np.uint8] = table[pixels]
        return scaled
    return _scale_in_place(pixels.astype(np.float64), stretch)


def _scale_in_place(values: NDArray[np.float64], stretch: Stretch) -> NDArray[np.uint8]:
    """Scale ``low..high`` to 0..255; overwrites ``values``."""
    np.clip(values, stretch.low, stretch.high, out=values)
    values -= stretch.low
    values *= 255 / (stretch.high - stretch.low)
    np.rint(values, out=values)
    return values.astype(np.uint8)
