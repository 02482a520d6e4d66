"""Votes of boxes: each box is a car of about the reference length, or something else of any length."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.scale.density import GRID, KERNEL_REACH_SDS, LOG_STEP, flat, normalised
from vehanchor.scale.reliability import CAR_LOG_SD

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

_LEAST_ODDS, _MOST_ODDS = -7.0, 5.3  # log odds of a car, 1 in 1,000 to 199 in 200: no box is certain
_ODDS_STEP, _SD_STEP = 0.25, 0.01  # votes are binned by odds and spread: the cost hardly depends on their number


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
    lengths_px: ArrayLike, scores: ArrayLike, lengths_m: ArrayLike, votes: Votes, log_sds: ArrayLike = CAR_LOG_SD
) -> NDArray[np.float64]:
    """Compute the density of the scale from the votes of all boxes.

    The likelihood of a scale g is the product over boxes of ``1 + o N(log length; log(L / g), sd)``. Here o is the
    odds that a box of its score is a car, relative to a density of 1 per unit of log length for other things.

    Args:
        lengths_px: ``[n]`` pixels of the full image.
        scores: ``[n]`` detection scores.
        lengths_m: ``[n]`` or one for all, ``L``: lengths in metres if they are cars.
        votes: of the detector.
        log_sds: ``[n]`` or one for all, standard deviations of the logs of both lengths.

    Returns:
        ``[g]`` probabilities; the flat density without boxes.
    """
    lengths = np.asarray(lengths_px, dtype=np.float64)
    if len(lengths) == 0:
        return flat()
    cells = np.rint((np.log(np.asarray(lengths_m) / lengths) - GRID[0]) / LOG_STEP).astype(np.intp)
    odds = votes.log_odds(scores)
    inside = (cells >= 0) & (cells < len(GRID))
    spreads = np.maximum(np.round(np.broadcast_to(log_sds, lengths.shape) / _SD_STEP), 1) * _SD_STEP
    total = np.zeros(len(GRID))
    for level, log_sd in sorted(set(zip(odds[inside].tolist(), spreads[inside].tolist(), strict=True))):
        chosen = inside & (odds == level) & (spreads == log_sd)
        reach = int(np.ceil(KERNEL_REACH_SDS * log_sd / LOG_STEP))
        offsets = np.arange(-reach, reach + 1) * LOG_STEP / log_sd
        normal = np.exp(-0.5 * offsets**2) / (log_sd * np.sqrt(2 * np.pi))
        counts = np.bincount(cells[chosen], minlength=len(GRID)).astype(np.float64)
        total += np.convolve(counts, np.log1p(np.exp(level) * normal))[reach : reach + len(GRID)]
    return normalised(np.exp(total - total.max()))
