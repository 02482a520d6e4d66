"""Densities over the log of the ground sampling distance, and their product, the posterior of all rulers.

All densities are cell probabilities on one grid (``GRID``: steps of 0.5 % from 3 mm to 3 m per pixel). The density of a
ruler that may be an outlier is mixed with a flat floor before the product, so that no single ruler can veto the others.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.scale.lengths import Interval

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike, NDArray

LOG_STEP = 0.005
TOLERANCE = 0.2  # largest relative error with which a planner can use a scale
USABLE_CHANCE = 0.9  # least probability of an error within the tolerance for a usable scale
_LEAST_CHANCE = 1e-6
_UNFORESEEN = 0.005  # of 206 usable scales from five cars and more, in places that no network had seen, 1 was wrong
_FINEST, _COARSEST = 0.003, 3.0  # metres per pixel
GRID: NDArray[np.float64] = np.arange(np.log(_FINEST), np.log(_COARSEST), LOG_STEP)
"""``[g]`` natural logs of metres per pixel."""

_BASIN = 0.25  # of log scale on either side of the highest cell: extent of one mode
_WINDOW = 0.2  # of log scale on either side: window to compare the strength of modes
_SHARE_LEVELS = 24  # votes are binned by their weight, so that the cost is independent of their number
_KERNEL_REACH_SDS = 6.0
_LEAST_SHARE, _MOST_SHARE = 1e-3, 0.995


class Votes(NamedTuple):
    """Vote model of a detector, fitted by ``research/training/fusion/fit.py`` on images of known scale.

    Attributes:
        share_at_zero: log odds that a box of score 0 is a car; in a new place less than where the detector was trained.
        share_slope: increase of these log odds from score 0 to 1.
        log_sd: standard deviation of the log of a car's measured length, from the box and from makes and models.
        clutter_density: density of false alarms per unit of log length.
        trust: exponent on the product of the votes, because the errors of boxes in one image are correlated.
        chance_wrong: weight of the flat density: probability that no box is a car.
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
        """Compute the probability that each box is a car from its score."""
        odds = self.share_at_zero + self.share_slope * np.asarray(scores, dtype=np.float64)
        return np.clip(1.0 / (1.0 + np.exp(-odds)), _LEAST_SHARE, _MOST_SHARE)


class Fused(NamedTuple):
    """Interval and chance of a scale by the posterior of all rulers.

    Attributes:
        interval: 95 % interval, extended to contain the scale itself.
        p_within_20: probability of an error below 20 %.
    """

    interval: Interval
    p_within_20: float


def fuse(gsd_m_per_px: float, *densities: NDArray[np.float64], sharpness: float = 1.0) -> Fused:
    """Compute interval and chance of a scale from the product of the rulers' densities.

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
    return Fused(interval, (1.0 - _UNFORESEEN) * float(chance))


def recalibrated(chance: ArrayLike, sharpness: float) -> NDArray[np.float64]:
    """Scale log-odds around ``USABLE_CHANCE``.

    A chance above that limit stays above it for any sharpness.

    Args:
        chance: ``[...]`` 0..1, mass of a density within the tolerance.
        sharpness: fitted by ``research/training/fusion/fit.py`` on images of known scale; 1 changes nothing.
    """
    inside = np.clip(np.asarray(chance, np.float64), _LEAST_CHANCE, 1 - _LEAST_CHANCE)
    limit = np.log(USABLE_CHANCE / (1 - USABLE_CHANCE))
    odds = limit + sharpness * (np.log(inside / (1 - inside)) - limit)
    return np.asarray(1.0 / (1.0 + np.exp(-odds)))


def flat() -> NDArray[np.float64]:
    """Return the flat density: ``[g]`` equal probabilities."""
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


def blurred(density: NDArray[np.float64], log_sd: float, finer_log_sd: float | None = None) -> NDArray[np.float64]:
    """Widen a density by an error that all of its votes share, such as that of the reference length.

    Args:
        density: ``[g]`` probabilities.
        log_sd: standard deviation of the error's log.
        finer_log_sd: its standard deviation towards finer scales; None for the same.

    Returns:
        ``[g]`` probabilities.
    """
    finer_log_sd = log_sd if finer_log_sd is None else finer_log_sd
    if max(log_sd, finer_log_sd) < LOG_STEP / 10:  # narrower than a cell
        return density
    reach = int(np.ceil(_KERNEL_REACH_SDS * max(log_sd, finer_log_sd) / LOG_STEP))
    errors = np.arange(-reach, reach + 1) * LOG_STEP
    kernel = np.exp(-0.5 * (errors / np.maximum(np.where(errors < 0, finer_log_sd, log_sd), 1e-9)) ** 2)
    return _normalised(np.maximum(np.convolve(density, kernel)[reach : reach + len(density)], 0.0))


def product(*densities: NDArray[np.float64]) -> NDArray[np.float64]:
    """Multiply densities of independent rulers.

    Args:
        *densities: ``[g]`` probabilities each, positive together in at least one cell.

    Returns:
        ``[g]`` probabilities.
    """
    logs = np.sum([np.log(np.maximum(density, 1e-300)) for density in densities], axis=0)
    return _normalised(np.exp(logs - logs.max()))


def strongest_mode(densities: Sequence[NDArray[np.float64]]) -> tuple[float, Interval, NDArray[np.float64]]:
    """Multiply densities; find the median of the strongest mode, and the interval of all modes.

    Args:
        densities: ``[g]`` probabilities each, at least one.

    Returns:
        The median, metres per pixel; the 95 % interval, extended to contain it; and the product, ``[g]``.
    """
    posterior = product(*densities)
    gsd = _mode_median(posterior)
    low, high = credible_interval(_not_all_wrong(densities))
    return gsd, Interval(min(low, gsd), max(high, gsd)), posterior


def _not_all_wrong(densities: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Multiply densities, given that not all rulers are wrong at once.

    A ruler that may be wrong has an outlier floor. The case that all are wrong lowers the chance; in the interval, it
    would cover the whole grid.
    """
    logs = np.sum([np.log(np.maximum(density, 1e-300)) for density in densities], axis=0)
    all_wrong = sum(np.log(max(float(density.min()), 1e-300)) for density in densities)
    right = np.maximum(np.exp(logs - logs.max()) - np.exp(all_wrong - logs.max()), 0.0)
    return np.asarray(right / right.sum())


def _mode_median(posterior: NDArray[np.float64]) -> float:
    """Compute the median of the strongest mode of the posterior, metres per pixel."""
    reach = round(_WINDOW / LOG_STEP)
    below = np.concatenate([np.zeros(reach + 1), np.cumsum(posterior), np.full(reach, posterior.sum())])
    middle = int(np.argmax(below[2 * reach + 1 :] - below[: len(posterior)]))
    inside = slice(max(0, middle - reach), middle + reach + 1)
    return median_near(float(np.exp(GRID[inside][int(np.argmax(posterior[inside]))])), posterior)


def median_near(gsd_m_per_px: float, posterior: NDArray[np.float64]) -> float:
    """Compute the median of the mode around a scale: of a posterior, ``[g]``, within 25 % of it, metres per pixel."""
    mode = np.where(np.abs(GRID - np.log(gsd_m_per_px)) <= _BASIN, posterior, 0.0)
    return credible_interval(mode / mode.sum(), probability=0.0).low


def vehicle_density(
    lengths_px: ArrayLike,
    scores: ArrayLike,
    reference_length_m: float,
    reference_log_sds: tuple[float, float],
    votes: Votes,
    more_log_sds: ArrayLike = 0.0,
) -> NDArray[np.float64]:
    """Compute the density of the scale from the votes of all boxes.

    The likelihood of a scale g is the product over boxes of ``(1 - p) + p N(log length; log(L_ref / g), sd) / u``, to
    the power ``trust``. Here p is the probability that a box of its score is a car, and u the density of clutter. The
    boxes of all levels share the error of the reference length.

    Args:
        lengths_px: ``[n]`` pixels of the full image.
        scores: ``[n]`` detection scores.
        reference_length_m: ``L_ref``.
        reference_log_sds: standard deviations of its log between places, towards smaller and towards larger cars.
        votes: vote model of the detector.
        more_log_sds: ``[n]`` or one for all, further standard deviations of the log lengths, as by pointing.

    Returns:
        ``[g]`` probabilities; the flat density without boxes.
    """
    lengths = np.asarray(lengths_px, dtype=np.float64)
    if len(lengths) == 0:
        return flat()
    cells = np.rint((np.log(reference_length_m / lengths) - GRID[0]) / LOG_STEP).astype(np.intp)
    shares = votes.car_shares(scores)
    inside = (cells >= 0) & (cells < len(GRID))
    level = np.minimum((shares * _SHARE_LEVELS).astype(np.intp), _SHARE_LEVELS - 1)
    log_sds = np.hypot(votes.log_sd, np.broadcast_to(more_log_sds, lengths.shape))
    total = np.zeros(len(GRID))
    for step, log_sd in sorted(set(zip(level[inside].tolist(), log_sds[inside].tolist(), strict=True))):
        chosen = inside & (level == step) & (log_sds == log_sd)
        reach = int(np.ceil(_KERNEL_REACH_SDS * log_sd / LOG_STEP))
        offsets = np.arange(-reach, reach + 1) * LOG_STEP / log_sd
        normal = np.exp(-0.5 * offsets**2) / (log_sd * np.sqrt(2 * np.pi))
        share = float(shares[chosen].mean())
        gain = np.log1p(share / (1 - share) * normal / votes.clutter_density)  # relative to clutter
        counts = np.bincount(cells[chosen], minlength=len(GRID)).astype(np.float64)
        total += np.convolve(counts, gain)[reach : reach + len(GRID)]
    density = _normalised(np.exp(votes.trust * (total - total.max())))
    smaller, larger = reference_log_sds
    return with_outlier_floor(blurred(density, larger, smaller), votes.chance_wrong)


def credible_interval(density: NDArray[np.float64], probability: float = 0.95) -> Interval:
    """Compute the central interval of a density.

    Args:
        density: ``[g]`` probabilities.
        probability: probability inside the interval.

    Returns:
        Metres per pixel, low and high.
    """
    below = np.cumsum(density)
    tail = (1.0 - probability) / 2
    low, high = np.interp([tail, 1.0 - tail], below, GRID + LOG_STEP / 2)
    return Interval(float(np.exp(low)), float(np.exp(high)))


def mass_within(density: NDArray[np.float64], gsd_m_per_px: float, tolerance: float) -> float:
    """Compute the probability that a scale is correct within a relative tolerance.

    Args:
        density: ``[g]`` probabilities of the true scale.
        gsd_m_per_px: the estimated scale.
        tolerance: largest ``|estimated - true| / true``.

    Returns:
        In 0..1.
    """
    low, high = np.log(gsd_m_per_px / (1 + tolerance)), np.log(gsd_m_per_px / (1 - tolerance))
    below = np.concatenate([[0.0], np.cumsum(density)])
    edges = np.concatenate([GRID - LOG_STEP / 2, [GRID[-1] + LOG_STEP / 2]])
    return float(np.interp(high, edges, below) - np.interp(low, edges, below))


def _normalised(density: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(density / density.sum())
