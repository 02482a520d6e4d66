"""Detail share: the share of an image's resolution that holds real detail; upsampling reduces it.

An image enlarged by r has no power above 1 / (2 r) cycles per pixel, whatever the interpolation.
Its spectrum drops in a step there, while that of a photograph falls slowly.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, TypeAlias

import cv2
import numpy as np

from vehanchor.imagery.raster import Window
from vehanchor.imagery.tiles import read_reduced_window

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster, RgbImage

    Spectrum: TypeAlias = NDArray[np.float64]
    """``[33]`` mean power at 0, 1, .. 32 cycles per patch."""

PATCH_PX = 64
"""Side of the patches whose spectra are averaged."""

_MAX_PATCHES = 16

_POWER_FLOOR = 1e-3
"""Power added to each ring, in grey levels squared; far below the rounding noise of 8 bits."""

_MIN_CUT = 5
"""Lowest frequency that is tested, in cycles per patch; lower ones have too few cycles."""

_EMPTY_DECADES = -2.2
"""Power relative to the usual decline, in decades, below which a frequency holds no detail.

2 % of the photographs in the train split lie below it.
"""


def ring_spectrum(patches: Iterable[RgbImage]) -> Spectrum:
    """Compute the mean power of patches by frequency.

    The rings are square because resampling filters rows and columns separately.

    Args:
        patches: ``[64, 64, 3]`` uint8 RGB each.

    Returns:
        ``[33]`` mean power per cell of the rings at 0, 1, .. 32 cycles per patch.
    """
    frequency = np.abs(np.fft.fftfreq(PATCH_PX, 1 / PATCH_PX))
    larger_frequency = np.maximum.outer(frequency, frequency)
    rings = larger_frequency.astype(np.intp).ravel()
    # The taper without its zeros at both ends suppresses the step between opposite borders, which
    # would add power at all frequencies.
    taper = np.hanning(PATCH_PX + 2)[1:-1]
    taper_2d = np.outer(taper, taper)
    total_power = np.zeros(PATCH_PX // 2 + 1)
    n_patches = 0
    for patch in patches:
        grey = cv2.cvtColor(patch, cv2.COLOR_RGB2GRAY)
        levels = grey.astype(np.float64)
        deviation = levels - levels.mean()
        spectrum = np.fft.fft2(deviation * taper_2d)
        power = np.abs(spectrum) ** 2
        total_power += np.bincount(rings, weights=power.ravel())
        n_patches += 1
    cells_per_ring = np.bincount(rings)
    return np.asarray(total_power / cells_per_ring / max(n_patches, 1))


def spectrum_share(spectrum: Spectrum) -> float:
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
    log_power = np.log10(spectrum + _POWER_FLOOR)
    for cut in range(_MIN_CUT, highest):
        # Fine: the mean of logs over the rings c .. 1.5 c, at least three at the end.
        first = min(cut, highest - 2)
        last = min(highest, math.ceil(1.5 * cut))
        fine_rings = slice(first, last + 1)
        fine = float(np.mean(log_power[fine_rings]))
        # Coarse: the log of the mean over the rings c/4 .. c/2.
        coarse_rings = slice(round(cut / 4), round(cut / 2) + 1)
        coarse_power = np.mean(spectrum[coarse_rings])
        coarse = float(np.log10(coarse_power + _POWER_FLOOR))
        # Power falls with the square of the frequency, between the geometric middles of both.
        fine_frequency = math.sqrt(first * last)
        coarse_frequency = cut * math.sqrt(1 / 8)
        usual_decline = 2 * math.log10(fine_frequency / coarse_frequency)
        if fine - coarse + usual_decline < _EMPTY_DECADES:
            return cut / highest
    return 1.0


def measure_detail_share(
    raster: Raster, centres: NDArray[np.float64], reduction: float = 1.0
) -> float:
    """Measure the share of the resolution that holds detail around vehicles.

    Args:
        raster: the image, or the part of one that shows the vehicles.
        centres: ``[n, 2]`` x, y of vehicles in pixels of the image; at most 16 are used.
        reduction: reduction at which the vehicles were detected: 1, 0.5, 0.25 or 0.125.

    Returns:
        ``spectrum_share`` of the reduced image; 1 without vehicles or if a side is below 64 px.
    """
    factor = round(1 / reduction)
    width = raster.width_px // factor
    height = raster.height_px // factor
    if len(centres) == 0 or min(width, height) < PATCH_PX:
        return 1.0
    # Vehicles at even steps through the list bound the cost.
    n_patches = min(_MAX_PATCHES, len(centres))
    steps = np.linspace(0, len(centres) - 1, n_patches)
    indexes = np.unique(steps.round().astype(int))
    centres_in_part = centres[indexes] - raster.origin_px
    reduced_centres = np.rint(centres_in_part / factor)
    unclipped_corners = reduced_centres.astype(int) - PATCH_PX // 2
    last_corner = (width - PATCH_PX, height - PATCH_PX)
    corners = np.clip(unclipped_corners, 0, last_corner)
    patches = (_read_patch(raster, corner, factor) for corner in corners)
    return spectrum_share(ring_spectrum(patches))


def _read_patch(raster: Raster, corner: NDArray[np.int_], factor: int) -> RgbImage:
    """Read the patch at a top left corner ``[2]`` in pixels of the reduced image."""
    x, y = corner.tolist()
    window = Window(x, y, width_px=PATCH_PX, height_px=PATCH_PX)
    return read_reduced_window(raster, window, factor)
