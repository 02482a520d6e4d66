"""Detail along the rows and along the columns: an image that was resized one way has less in one.

Enlarging an image in one direction leaves no power at the highest frequencies there, and reducing
it moves power to them. Photographs have about as much detail in both directions. The motion of a
camera blurs one direction, too, so that the difference alone does not prove a stretch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.imagery.detail import PATCH_PX
from vehanchor.imagery.raster import Window

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster

    Patches: TypeAlias = NDArray[np.float32]
    """``[n, 64, 64]`` grey values."""

    Spectra: TypeAlias = NDArray[np.float32]
    """``[n, 33]`` power at 0, 1, .. 32 cycles per patch in one direction."""

# Numbers without a measurement beside them are choices.

# Side of the window in the middle of the image, and patches across and down it.
_WINDOW_PX = 1024
_PATCHES_ACROSS = 8
# Patches with a smaller spread of grey values show nothing.
_MIN_SPREAD = 2.0
_MIN_PATCHES = 4
# Cycles per patch of fine and of coarse detail, and those in the other direction that count.
_FINE = slice(10, 32)
_COARSE = slice(1, 6)
_ACROSS = 9
# Power that is added, in squared grey levels; below the rounding noise of 8 bits.
_POWER_FLOOR = 0.05


def measure_detail_difference(raster: Raster) -> float | None:
    """Measure how much more fine detail an image has along its rows than along its columns.

    Returns:
        The difference of the mean logs of the power of fine detail, less that of coarse detail:
        below 0 if the image was enlarged across, above 0 if it was enlarged down. None for a small
        image, and for one without texture.
    """
    width = min(raster.width_px, _WINDOW_PX)
    height = min(raster.height_px, _WINDOW_PX)
    if min(width, height) < PATCH_PX:
        return None
    left = (raster.width_px - width) // 2
    top = (raster.height_px - height) // 2
    pixels = raster.read(Window(left, top, width_px=width, height_px=height))
    grey = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY), np.float32)
    patches = _patches(grey)
    if len(patches) < _MIN_PATCHES:
        return None
    # The taper suppresses the step between opposite borders of a patch.
    taper = np.hanning(PATCH_PX + 2)[1:-1].astype(np.float32)
    means = patches.mean(axis=(1, 2), keepdims=True)
    tapered = (patches - means) * np.outer(taper, taper)
    along_rows = _spectra(tapered)
    along_columns = _spectra(tapered.transpose(0, 2, 1))
    surplus = np.log(along_rows + _POWER_FLOOR) - np.log(along_columns + _POWER_FLOOR)
    by_frequency = surplus.mean(axis=0)
    return float(by_frequency[_FINE].mean() - by_frequency[_COARSE].mean())


def _patches(grey: NDArray[np.float32]) -> Patches:
    """Cut patches at even steps out of an image, and leave out those without texture."""
    height, width = grey.shape
    rows = np.linspace(0, height - PATCH_PX, min(_PATCHES_ACROSS, height // PATCH_PX))
    columns = np.linspace(0, width - PATCH_PX, min(_PATCHES_ACROSS, width // PATCH_PX))
    patches = []
    for top in rows.round().astype(int):
        for left in columns.round().astype(int):
            patches.append(grey[top : top + PATCH_PX, left : left + PATCH_PX])
    stacked = np.stack(patches)
    return np.asarray(stacked[stacked.std(axis=(1, 2)) >= _MIN_SPREAD])


def _spectra(patches: Patches) -> Spectra:
    """Compute the power along the rows of patches, at low frequencies along their columns."""
    power = np.abs(np.fft.rfft2(patches)) ** 2
    low = [*range(_ACROSS), *range(PATCH_PX - _ACROSS + 1, PATCH_PX)]
    return np.asarray(power[:, low].mean(axis=1), np.float32)
