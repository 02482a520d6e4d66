"""Densities over the log of the ground sampling distance: what rulers say, multiplied into one posterior.

All densities lie on one grid (``GRID``: steps of half a per cent from 3 mm to 3 m a pixel) and are kept as
probabilities of its cells. A ruler that may be wrong altogether is mixed with a flat floor before it is multiplied, so
that one liar cannot veto the others.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.scale.lengths import Interval

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

LOG_STEP = 0.005
TOLERANCE = 0.2  # relative error up to which a planner can use a scale
USABLE_CHANCE = 0.9  # of an error below it: with less a scale is not to be used
_LEAST_CHANCE = 1e-6
_FINEST, _COARSEST = 0.003, 3.0  # metres per pixel
GRID: NDArray[np.float64] = np.arange(np.log(_FINEST), np.log(_COARSEST), LOG_STEP)
"""``[g]`` natural logs of metres per pixel."""

_SHARE_LEVELS = 24  # votes are binned by their weight, so that the cost does not grow with the vehicles
_KERNEL_REACH_SDS = 6.0
_LEAST_SHARE, _MOST_SHARE = 1e-3, 0.995


class Votes(NamedTuple):
    """How the boxes of one detector vote, fitted by ``research/training/fusion/fit.py`` on images of known scale.

    Attributes:
        share_at_zero: log odds that a box of score 0 is a car.
        share_slope: what a score of 1 adds to them.
        log_sd: standard deviation of the log of a car's measured length: of the box and of makes and models together.
        clutter_density: density of false alarms per unit of log length: over how wide a range they are spread.
        trust: exponent on the votes together: boxes of one image err alike, so that n of them say less than n.
        chance_wrong: weight of the flat density: that none of them are cars.
        sharpness: see ``recalibrated``.
    """

    share_at_zero: float
    share_slope: float
    log_sd: float
    clutter_density: float
    trust: float
    chance_wrong: float
    sharpness: float = 1.0

    def car_shares(self, scores: ArrayLike) -> NDArray[np.float64]:
        """Chance that each box is a car, from its score."""
        odds = self.share_at_zero + self.share_slope * np.asarray(scores, dtype=np.float64)
        return np.asarray(1.0 / (1.0 + np.exp(-odds)))


class Fused(NamedTuple):
    """Interval and chance of a scale by the posterior of all rulers.

    Attributes:
        interval: holds the true scale in 95 of 100 images, and the scale itself.
        p_within_20: chance that its error is below a fifth.
    """

    interval: Interval
    p_within_20: float


def fuse(gsd_m_per_px: float, *densities: NDArray[np.float64], sharpness: float = 1.0) -> Fused:
    """Judge a scale by the product of the rulers' densities.

    Args:
        gsd_m_per_px: the scale.
        *densities: ``[g]`` probabilities each.
        sharpness: see ``recalibrated``.

    Returns:
        Its interval and chance.
    """
    posterior = product(*densities)
    low, high = credible_interval(posterior)
    interval = Interval(min(low, gsd_m_per_px), max(high, gsd_m_per_px))
    chance = recalibrated(mass_within(posterior, gsd_m_per_px, TOLERANCE), sharpness)
    return Fused(interval, float(chance))


def recalibrated(chance: ArrayLike, sharpness: float) -> NDArray[np.float64]:
    """Scale log-odds around ``USABLE_CHANCE``.

    A usable chance stays usable, whatever the factor.

    Args:
        chance: ``[...]`` 0..1, mass of a density within the tolerance.
        sharpness: fitted by ``research/training/fusion/fit.py`` on images of known scale; 1 changes nothing.
    """
    inside = np.clip(np.asarray(chance, np.float64), _LEAST_CHANCE, 1 - _LEAST_CHANCE)
    limit = np.log(USABLE_CHANCE / (1 - USABLE_CHANCE))
    odds = limit + sharpness * (np.log(inside / (1 - inside)) - limit)
    return np.asarray(1.0 / (1.0 + np.exp(-odds)))


def flat() -> NDArray[np.float64]:
    """Return the density that says nothing: ``[g]`` equal probabilities."""
    return np.full(len(GRID), 1.0 / len(GRID))


def with_outlier_floor(density: NDArray[np.float64], chance_wrong: float) -> NDArray[np.float64]:
    """Mix a density with the flat one.

    Args:
        density: ``[g]`` probabilities.
        chance_wrong: 0..1, weight of the flat one.

    Returns:
        ``[g]`` probabilities.
    """
    return np.asarray((1.0 - chance_wrong) * density + chance_wrong / len(GRID))


def blurred(density: NDArray[np.float64], log_sd: float) -> NDArray[np.float64]:
    """Widen a density by an error that all of its votes share, such as that of the reference length.

    Args:
        density: ``[g]`` probabilities.
        log_sd: standard deviation of the error's log.

    Returns:
        ``[g]`` probabilities.
    """
    if log_sd < LOG_STEP / 10:  # narrower than a cell
        return density
    reach = int(np.ceil(_KERNEL_REACH_SDS * log_sd / LOG_STEP))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) * LOG_STEP / log_sd) ** 2)
    return _normalised(np.maximum(np.convolve(density, kernel)[reach : reach + len(density)], 0.0))


def product(*densities: NDArray[np.float64]) -> NDArray[np.float64]:
    """Multiply densities of independent rulers.

    Args:
        *densities: ``[g]`` probabilities each, none of them all zero where the others are not.

    Returns:
        ``[g]`` probabilities.
    """
    logs = np.sum([np.log(np.maximum(density, 1e-300)) for density in densities], axis=0)
    return _normalised(np.exp(logs - logs.max()))


def vehicle_density(
    lengths_px: ArrayLike, scores: ArrayLike, reference_length_m: float, reference_sd_m: float, votes: Votes
) -> NDArray[np.float64]:
    """Let every box vote for the scale at which it would be a car, or for none where it is no car.

    The likelihood of a scale g is the product over boxes of ``(1 - p) + p N(log length; log(L_ref / g), sd) / u``, with
    p the chance that a box of its score is a car and u the density of clutter, to the power ``trust``. All levels of a
    search are judged together; what the reference length itself may be off by, they share.

    Args:
        lengths_px: ``[n]`` pixels of the full image.
        scores: ``[n]`` detection scores.
        reference_length_m: ``L_ref``.
        reference_sd_m: its standard deviation between places, metres.
        votes: of the detector.

    Returns:
        ``[g]`` probabilities; the flat density for no boxes.
    """
    lengths = np.asarray(lengths_px, dtype=np.float64)
    if len(lengths) == 0:
        return flat()
    cells = np.rint((np.log(reference_length_m / lengths) - GRID[0]) / LOG_STEP).astype(np.intp)
    shares = np.clip(votes.car_shares(scores), _LEAST_SHARE, _MOST_SHARE)
    inside = (cells >= 0) & (cells < len(GRID))
    level = np.minimum((shares * _SHARE_LEVELS).astype(np.intp), _SHARE_LEVELS - 1)
    reach = int(np.ceil(_KERNEL_REACH_SDS * votes.log_sd / LOG_STEP))
    offsets = np.arange(-reach, reach + 1) * LOG_STEP / votes.log_sd
    normal = np.exp(-0.5 * offsets**2) / (votes.log_sd * np.sqrt(2 * np.pi))
    total = np.zeros(len(GRID))
    for step in np.unique(level[inside]):
        chosen = inside & (level == step)
        share = float(shares[chosen].mean())
        gain = np.log1p(share / (1 - share) * normal / votes.clutter_density)  # over a scale at which it is no car
        counts = np.bincount(cells[chosen], minlength=len(GRID)).astype(np.float64)
        total += np.convolve(counts, gain)[reach : reach + len(GRID)]
    density = _normalised(np.exp(votes.trust * (total - total.max())))
    return with_outlier_floor(blurred(density, reference_sd_m / reference_length_m), votes.chance_wrong)


def credible_interval(density: NDArray[np.float64], probability: float = 0.95) -> Interval:
    """Take the central interval of a density: equal shares are left out on both sides.

    Args:
        density: ``[g]`` probabilities.
        probability: what lies inside.

    Returns:
        Metres per pixel, low and high.
    """
    below = np.cumsum(density)
    tail = (1.0 - probability) / 2
    low, high = np.interp([tail, 1.0 - tail], below, GRID + LOG_STEP / 2)
    return Interval(float(np.exp(low)), float(np.exp(high)))


def mass_within(density: NDArray[np.float64], gsd_m_per_px: float, tolerance: float) -> float:
    """Sum the probability that a scale is right within a relative tolerance.

    Args:
        density: ``[g]`` probabilities of the true scale.
        gsd_m_per_px: the scale that is given out.
        tolerance: largest ``|given - true| / true``.

    Returns:
        In 0..1.
    """
    low, high = np.log(gsd_m_per_px / (1 + tolerance)), np.log(gsd_m_per_px / (1 - tolerance))
    below = np.concatenate([[0.0], np.cumsum(density)])
    edges = np.concatenate([GRID - LOG_STEP / 2, [GRID[-1] + LOG_STEP / 2]])
    return float(np.interp(high, edges, below) - np.interp(low, edges, below))


def _normalised(density: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(density / density.sum())
