"""Contrast stretch: conversion of stored values above 8 bits to 8-bit images."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from vehanchor.errors import ImageFormatError

if TYPE_CHECKING:
    from numpy.typing import NDArray

STRETCH_PERCENTILES = (2.0, 98.0)
"""Percentiles of the whole image that become 0 and 255, as in GIS viewers. All three bands share one range, which
keeps the colour balance."""

SAMPLE_PX = 1 << 20
"""Maximum number of pixels in the sample for the percentiles; smaller images are used whole."""


class Stretch(NamedTuple):
    """Stored values that become 0 and 255."""

    low: float
    high: float


UNIT_RANGE = Stretch(0.0, 1.0)
# share of the pixels from which a value reaches the percentiles
_LEAST_EMPTY = 1 - STRETCH_PERCENTILES[1] / 100


def find_no_data(sample: NDArray[Any]) -> tuple[float, float] | None:
    """Find a value that stands for "no data" without being declared, as -9999 or 65535 beside values of 12 bits.

    Args:
        sample: finite values of the image, ``[n, bands]``.

    Returns:
        The lowest or highest value and its share, if it fills all bands of 2 % of the pixels and is
        apart from all others by more than their whole range; None otherwise. Clipped highlights are
        next to other values.
    """
    for extreme in (sample.min(), sample.max()) if sample.size else ():
        empty = (sample == extreme).all(axis=1)
        if not _LEAST_EMPTY < empty.mean() < 1:
            continue
        others = sample[~empty]
        least = float(others.min())
        most = float(others.max())
        if max(least - float(extreme), float(extreme) - most) > most - least > 0:
            return float(extreme), float(empty.mean())
    return None


def choose_stretch(sample: NDArray[Any]) -> Stretch | None:
    """Choose the values of an image that become 0 and 255.

    Args:
        sample: finite values of the image, of any shape.

    Returns:
        The stretch; None for uint8, which needs none.

    Raises:
        ImageFormatError: the range of the floats is too large to scale.
    """
    if sample.dtype == np.uint8:
        return None
    if sample.size == 0:  # no data: every stretch gives black
        return UNIT_RANGE
    least = float(sample.min())
    most = float(sample.max())
    if sample.dtype.kind == "f" and least >= 0 and most <= 1:
        return UNIT_RANGE
    # "nearest" does no arithmetic between values, so the largest floats do not overflow
    low, high = (
        float(value) for value in np.percentile(sample, STRETCH_PERCENTILES, method="nearest")
    )
    if low == high:
        low = least
        high = most
    if low == high:
        high = low + max(1.0, abs(low))  # constant: all black
    if not math.isfinite(255 / (high - low)) or math.isinf(high - low):
        raise ImageFormatError(
            f"pixel values from {low:g} to {high:g} cannot be scaled; rescale the image to 0..1"
        )
    return Stretch(low, high)


def to_uint8(pixels: NDArray[Any], stretch: Stretch) -> NDArray[np.uint8]:
    """Convert stored values of any shape to 0..255."""
    if pixels.dtype == np.uint16:
        table = _scaled(np.arange(1 << 16, dtype=np.float64), stretch)
        shown: NDArray[np.uint8] = table[pixels]
        return shown
    return _scaled(pixels.astype(np.float64), stretch)


def _scaled(values: NDArray[np.float64], stretch: Stretch) -> NDArray[np.uint8]:
    """Scale ``low..high`` to 0..255; overwrites ``values``."""
    np.clip(values, stretch.low, stretch.high, out=values)
    values -= stretch.low
    values *= 255 / (stretch.high - stretch.low)
    return np.rint(values, out=values).astype(np.uint8)
