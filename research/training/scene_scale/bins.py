"""Bins over log metres per pixel, and the training targets."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

BINS = 66
# Width of a bin; the last one is 1.15 m/px.
LOG_STEP = 0.07
# Centre of the first bin, 0.0122 m/px.
FIRST_LOG_GSD = float(np.log(0.0245)) - 10 * LOG_STEP
# Spread of the soft target, in log (rulers.md).
LABEL_SPREAD = 0.12
LOG_GSD = FIRST_LOG_GSD + LOG_STEP * np.arange(BINS)


def soft_target(
    gsd_m_per_px: float, label_spread: float = 0.0, lost: float = 0.0
) -> NDArray[np.float32]:
    """Compute the distribution over the bins with which a crop is labelled.

    Args:
        gsd_m_per_px: of the crop.
        label_spread: log standard deviation of the label itself, added to ``LABEL_SPREAD`` in
            quadrature.
        lost: share of the flat distribution; 1 where the crop shows nothing that has a size.

    Returns:
        Probabilities ``[BINS]``.
    """
    off = (LOG_GSD - np.log(gsd_m_per_px)) / np.hypot(LABEL_SPREAD, label_spread)
    peak = np.exp(-0.5 * off**2)
    return np.asarray((1 - lost) * peak / peak.sum() + lost / BINS, np.float32)
