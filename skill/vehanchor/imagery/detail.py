"""How much of an image's resolution is real: an enlarged image has pixels, but no detail finer than its original's.

An image enlarged by r holds nothing above 1 / (2 r) cycles per pixel, whatever the interpolation: its spectrum falls
off a step there, while that of a photograph goes on falling slowly.
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
_LEAST_POWER = 1e-3  # of a cell of the spectrum, in grey levels squared: far below what rounding to 8 bits leaves
_LOWEST_CUT = 5  # cycles per patch: below, a patch holds too few
_EMPTY = -2.2  # decades below the usual fall; 2 in 100 photographs of the train split lie lower


def _rings() -> NDArray[np.intp]:
    """Ring of each cell of the discrete Fourier transform of a patch: the larger of the two frequencies."""
    frequency = np.abs(np.fft.fftfreq(PATCH_PX, 1 / PATCH_PX))
    return np.asarray(np.maximum(frequency[:, None], frequency[None, :]), dtype=np.intp)


def ring_spectrum(patches: Iterable[NDArray[np.uint8]]) -> NDArray[np.float64]:
    """Mean power of patches by frequency.

    The rings are squares and not circles, since resampling cuts rows and columns each for itself.

    Args:
        patches: ``[64, 64, 3]`` uint8 RGB each.

    Returns:
        ``[33]`` mean power per cell of the rings at 0, 1, .. 32 cycles per patch.
    """
    rings = _rings().ravel()
    taper = np.hanning(PATCH_PX + 2)[1:-1]
    total, count = np.zeros(PATCH_PX // 2 + 1), 0
    for patch in patches:
        grey = cv2.cvtColor(patch, cv2.COLOR_RGB2GRAY).astype(np.float64)
        power = np.abs(np.fft.fft2((grey - grey.mean()) * np.outer(taper, taper))) ** 2
        total += np.bincount(rings, weights=power.ravel())
        count += 1
    return np.asarray(total / np.bincount(rings) / max(count, 1))


def spectrum_share(spectrum: NDArray[np.float64]) -> float:
    """The share of the resolution down to which there is detail.

    At each frequency c from low to high, the power in c .. 1.5 c is compared with that in c/4 .. c/2. In photographs
    power falls with the square of the frequency and a little more; in an enlarged image it falls a hundred times lower
    where the original's detail ends. Blur does the same: what is lacking is the same, too.

    Args:
        spectrum: as ``ring_spectrum`` gives it.

    Returns:
        The first c at which next to nothing is left, over the highest frequency; 1 where that never happens.
    """
    highest = len(spectrum) - 1
    logs = np.log10(spectrum + _LEAST_POWER)
    for cut in range(_LOWEST_CUT, highest):
        first, last = min(cut, highest - 2), min(highest, math.ceil(1.5 * cut))
        fine = float(np.mean(logs[first : last + 1]))
        coarse = float(np.log10(np.mean(spectrum[round(cut / 4) : round(cut / 2) + 1]) + _LEAST_POWER))
        usual_fall = 2 * math.log10(math.sqrt(first * last) / (cut * math.sqrt(1 / 8)))
        if fine - coarse + usual_fall < _EMPTY:
            return cut / highest
    return 1.0


def resolved_share(raster: Raster, centres: NDArray[np.float64], scale: float = 1.0) -> float:
    """The share of the resolution down to which there is detail around vehicles.

    Args:
        raster: the image.
        centres: ``[n, 2]`` x, y of vehicles in pixels of the image; 16 of them at most are looked at.
        scale: of the copy of the image in which they were found: 1, 0.5, 0.25 or 0.125.

    Returns:
        ``spectrum_share`` of that copy; 1 without vehicles and for a copy of less than 64 px.
    """
    factor = round(1 / scale)
    width, height = raster.width_px // factor, raster.height_px // factor
    if len(centres) == 0 or min(width, height) < PATCH_PX:
        return 1.0
    chosen = np.unique(np.linspace(0, len(centres) - 1, min(_MAX_PATCHES, len(centres))).round().astype(int))
    corners = np.rint(centres[chosen] / factor).astype(int) - PATCH_PX // 2
    corners = np.clip(corners, 0, (width - PATCH_PX, height - PATCH_PX))
    return spectrum_share(
        ring_spectrum(
            read_reduced_window(raster, Window(int(x), int(y), PATCH_PX, PATCH_PX), factor) for x, y in corners
        )
    )
