"""Resolved detail: the share of an image's resolution that holds real detail, which upsampling reduces.

An image enlarged by r has no power above 1 / (2 r) cycles per pixel, whatever the interpolation.
Its spectrum drops in a step there, while that of a photograph falls slowly.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.imagery.raster import Window
from vehanchor.imagery.tiles import read_reduced_window

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster

PATCH_PX = 64
_MAX_PATCHES = 16
# per cell of the spectrum, grey levels squared: far below the rounding noise of 8 bits
_LEAST_POWER = 1e-3
_LOWEST_CUT = 5  # cycles per patch; lower frequencies have too few cycles
# decades below the usual decline; 2 % of the photographs in the train split are lower
_EMPTY = -2.2


def ring_spectrum(patches: Iterable[NDArray[np.uint8]]) -> NDArray[np.float64]:
    """Compute the mean power of patches by frequency.

    The rings are square because resampling filters rows and columns separately.

    Args:
        patches: ``[64, 64, 3]`` uint8 RGB each.

    Returns:
        ``[33]`` mean power per cell of the rings at 0, 1, .. 32 cycles per patch.
    """
    frequency = np.abs(np.fft.fftfreq(PATCH_PX, 1 / PATCH_PX))
    rings = np.maximum.outer(frequency, frequency).astype(np.intp).ravel()
    taper = np.hanning(PATCH_PX + 2)[1:-1]
    total = np.zeros(PATCH_PX // 2 + 1)
    count = 0
    for patch in patches:
        grey = cv2.cvtColor(patch, cv2.COLOR_RGB2GRAY).astype(np.float64)
        power = np.abs(np.fft.fft2((grey - grey.mean()) * np.outer(taper, taper))) ** 2
        total += np.bincount(rings, weights=power.ravel())
        count += 1
    return np.asarray(total / np.bincount(rings) / max(count, 1))


def spectrum_share(spectrum: NDArray[np.float64]) -> float:
    """Compute the share of the resolution that holds detail.

    For each frequency c, from low to high, compare the power in c .. 1.5 c with the power in c/4 ..
    c/2. In photographs power falls slightly faster than the square of the frequency. In an enlarged
    image it falls a hundred times lower where the original's detail ends. Blur has the same effect,
    and the same detail is missing.

    Args:
        spectrum: result of ``ring_spectrum``.

    Returns:
        The first c with almost no power, divided by the highest frequency; 1 if there is none.
    """
    highest = len(spectrum) - 1
    logs = np.log10(spectrum + _LEAST_POWER)
    for cut in range(_LOWEST_CUT, highest):
        first = min(cut, highest - 2)
        last = min(highest, math.ceil(1.5 * cut))
        fine = float(np.mean(logs[first : last + 1]))
        coarse = float(
            np.log10(np.mean(spectrum[round(cut / 4) : round(cut / 2) + 1]) + _LEAST_POWER)
        )
        usual_decline = 2 * math.log10(math.sqrt(first * last) / (cut * math.sqrt(1 / 8)))
        if fine - coarse + usual_decline < _EMPTY:
            return cut / highest
    return 1.0


def measure_detail_share(
    raster: Raster, centres: NDArray[np.float64], reduction: float = 1.0
) -> float:
    """Measure the share of the resolution that holds detail around vehicles.

    Args:
        raster: the image.
        centres: ``[n, 2]`` x, y of vehicles in pixels of the image; at most 16 are used.
        reduction: of the image in which they were found: 1, 0.5, 0.25 or 0.125.

    Returns:
        ``spectrum_share`` of the reduced image; 1 without vehicles or if a side is below 64 px.
    """
    factor = round(1 / reduction)
    width = raster.width_px // factor
    height = raster.height_px // factor
    if len(centres) == 0 or min(width, height) < PATCH_PX:
        return 1.0
    chosen = np.unique(
        np.linspace(0, len(centres) - 1, min(_MAX_PATCHES, len(centres))).round().astype(int)
    )
    corners = np.rint(centres[chosen] / factor).astype(int) - PATCH_PX // 2
    corners = np.clip(corners, 0, (width - PATCH_PX, height - PATCH_PX))
    return spectrum_share(
        ring_spectrum(
            read_reduced_window(
                raster, Window(int(x), int(y), width_px=PATCH_PX, height_px=PATCH_PX), factor
            )
            for x, y in corners
        )
    )
