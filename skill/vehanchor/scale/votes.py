"""Votes of boxes: each box is a car of about the reference length, or something else of any length."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.scale.density import GRID, LOG_STEP, flat, normalised
from vehanchor.scale.reliability import CAR_LOG_SD

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

_KERNEL_REACH_SDS = 6.0
_LEAST_ODDS, _MOST_ODDS = -7.0, 5.3  # log odds of a car, 1 in 1,000 to 199 in 200: no box is certain
_ODDS_STEP = 0.25  # votes are binned by their odds, so that the cost is independent of their number


class Votes(NamedTuple):
    """Chance that a detector's box is a car, fitted by ``research/training/fusion`` on images of known scale.

    Attributes:
        share_at_zero: log odds that a box of score 0 is a car; in a new place less than where the detector was trained.
        share_slope: increase of these log odds from score 0 to 1.
    """

    share_at_zero: float
    share_slope: float

    def log_odds(self, scores: ArrayLike) -> NDArray[np.float64]:
        """Compute the log odds that each box is a car from its score, in steps of a quarter."""
        odds = self.share_at_zero + self.share_slope * np.asarray(scores, dtype=np.float64)
        return np.round(np.clip(odds, _LEAST_ODDS, _MOST_ODDS) / _ODDS_STEP) * _ODDS_STEP


UNCALIBRATED = Votes(-4.0, 10.0)
"""Votes of a detector without fitted ones: a box of score 0.4 is a car or not, one of 0.9 nearly surely. A choice."""


def vehicle_likelihood(
    lengths_px: ArrayLike, scores: ArrayLike, reference_length_m: float, votes: Votes, more_log_sds: ArrayLike = 0.0
) -> NDArray[np.float64]:
    """Compute the density of the scale from the votes of all boxes, for a known reference length.

    The likelihood of a scale g is the product over boxes of ``1 + o N(log length; log(L_ref / g), sd)``. Here o is the
    odds that a box of its score is a car, relative to a density of 1 per unit of log length for other things.

    Args:
        lengths_px: ``[n]`` pixels of the full image.
        scores: ``[n]`` detection scores.
        reference_length_m: ``L_ref``.
        votes: of the detector.
        more_log_sds: ``[n]`` or one for all, further standard deviations of the log lengths, as by pointing.

    Returns:
        ``[g]`` probabilities; the flat density without boxes.
    """
    lengths = np.asarray(lengths_px, dtype=np.float64)
    if len(lengths) == 0:
        return flat()
    cells = np.rint((np.log(reference_length_m / lengths) - GRID[0]) / LOG_STEP).astype(np.intp)
    odds = votes.log_odds(scores)
    inside = (cells >= 0) & (cells < len(GRID))
    log_sds = np.hypot(CAR_LOG_SD, np.broadcast_to(more_log_sds, lengths.shape))
    total = np.zeros(len(GRID))
    for level, log_sd in sorted(set(zip(odds[inside].tolist(), log_sds[inside].tolist(), strict=True))):
        chosen = inside & (odds == level) & (log_sds == log_sd)
        reach = int(np.ceil(_KERNEL_REACH_SDS * log_sd / LOG_STEP))
        offsets = np.arange(-reach, reach + 1) * LOG_STEP / log_sd
        normal = np.exp(-0.5 * offsets**2) / (log_sd * np.sqrt(2 * np.pi))
        counts = np.bincount(cells[chosen], minlength=len(GRID)).astype(np.float64)
        total += np.convolve(counts, np.log1p(np.exp(level) * normal))[reach : reach + len(GRID)]
    return normalised(np.exp(total - total.max()))
