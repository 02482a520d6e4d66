"""Densities over the log of the ground sampling distance, among them the vehicles' votes.

A density holds ``[g]`` cell probabilities on one grid, ``GRID``: steps of 0.5 % from 3 mm to 3 m
per pixel.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from vehanchor.scale.lengths import Interval

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

Density: TypeAlias = "NDArray[np.float64]"
"""Probabilities ``[g]`` of the cells of ``GRID``."""

LOG_STEP = 0.005
# Largest ``|estimated - true| / true`` with which a planner can use a scale.
TOLERANCE = 0.2
# Ends of the grid, metres per pixel.
_FINEST = 0.003
_COARSEST = 3.0
GRID: NDArray[np.float64] = np.arange(np.log(_FINEST), np.log(_COARSEST), LOG_STEP)
"""``[g]`` natural logs of metres per pixel."""

# Smallest probability of a cell, so that it has a log.
MIN_PROBABILITY = 1e-300
# Beyond six standard deviations, a normal kernel is cut off.
KERNEL_REACH_SDS = 6.0
# Limits of the log odds of a car, 1 in 1,000 to 199 in 200: no box is certain.
_MIN_LOG_ODDS = -7.0
_MAX_LOG_ODDS = 5.3
# Votes are binned by odds and spread, so that the cost hardly depends on their number.
_LOG_ODDS_STEP = 0.25
_SD_STEP = 0.01


def flat() -> Density:
    """Return the flat density: ``[g]`` equal probabilities."""
    n_cells = len(GRID)
    return np.full(n_cells, 1.0 / n_cells)


def on_grid(gsd_m_per_px: float) -> bool:
    """Test whether a scale is possible: 3 mm to 3 m per pixel."""
    if gsd_m_per_px <= 0:
        return False
    log_gsd = math.log(gsd_m_per_px)
    return bool(GRID[0] <= log_gsd <= GRID[-1])


def lognormal(gsd_m_per_px: float, log_sd: float) -> Density:
    """Make a lognormal density.

    Args:
        gsd_m_per_px: its median, on the grid (see ``on_grid``).
        log_sd: standard deviation of its log; a smaller one than a cell counts as one cell.

    Returns:
        ``[g]`` probabilities.
    """
    log_errors = GRID - math.log(gsd_m_per_px)
    deviations = log_errors / max(log_sd, LOG_STEP)
    return normalised(np.exp(-0.5 * deviations**2))


def normalised(density: Density) -> Density:
    """Scale a non-negative density ``[g]`` to the sum 1."""
    return np.asarray(density / density.sum())


def blurred(density: Density, log_sd: float, log_mean: float = 0.0) -> Density:
    """Add a normal error of the log scale.

    Args:
        density: ``[g]``, of any sum, also 0.
        log_sd: standard deviation of the error; less than a sixtieth of a cell counts as exact.
        log_mean: mean of the error.

    Returns:
        ``[g]`` of the same sum.
    """
    reach = abs(log_mean) + KERNEL_REACH_SDS * log_sd
    if reach < LOG_STEP / 10:
        return density
    cells = math.ceil(reach / LOG_STEP)
    errors = np.arange(-cells, cells + 1) * LOG_STEP
    deviations = (errors - log_mean) / max(log_sd, LOG_STEP)
    kernel = normalised(np.exp(-0.5 * deviations**2))
    # The end cells are repeated, so that a flat floor stays flat up to the ends of the grid.
    padded = np.pad(density, cells, mode="edge")
    convolved = np.maximum(np.convolve(padded, kernel, mode="valid"), 0.0)
    # A part of the posterior with no mass stays so: it cannot be normalised.
    if not convolved.any():
        return density
    return np.asarray(density.sum() * normalised(convolved))


def product(*densities: Density) -> Density:
    """Multiply densities.

    Args:
        *densities: ``[g]`` probabilities each, positive together in at least one cell.

    Returns:
        ``[g]`` probabilities.
    """
    logs = [np.log(np.maximum(density, MIN_PROBABILITY)) for density in densities]
    log_product = np.sum(logs, axis=0)
    # The largest cell becomes 1 before the exponential, so that no product underflows.
    relative = log_product - log_product.max()
    return normalised(np.exp(relative))


def shifted(density: Density, offset: float) -> Density:
    """Shift a density ``[g]`` of log scale down by ``offset``, to another photograph's pixels."""
    if offset == 0:
        return density
    moved = np.interp(GRID + offset, GRID, density)
    return normalised(moved)


def quantile(density: Density, probability: float) -> float:
    """Compute a quantile of a density ``[g]``, metres per pixel."""
    upper_edges = GRID + LOG_STEP / 2
    mass_below = np.cumsum(density)
    log_gsd = np.interp(probability, mass_below, upper_edges)
    return float(np.exp(log_gsd))


def credible_interval(density: Density, probability: float = 0.95) -> Interval:
    """Compute the central interval of a density ``[g]`` with a probability, metres per pixel."""
    tail = (1.0 - probability) / 2
    low = quantile(density, tail)
    high = quantile(density, 1.0 - tail)
    return Interval(low, high)


def mass_within(density: Density, gsd_m_per_px: float) -> float:
    """Compute the mass of the true scales with which an estimate is at most 20 % off.

    Args:
        density: ``[g]`` probabilities of the true scale; their sum may be below 1.
        gsd_m_per_px: the estimated scale.

    Returns:
        At most the sum of the density.
    """
    # |estimated - true| / true <= 0.2 holds from estimated / 1.2 to estimated / 0.8.
    low = np.log(gsd_m_per_px / (1 + TOLERANCE))
    high = np.log(gsd_m_per_px / (1 - TOLERANCE))
    half_cell = LOG_STEP / 2
    edges = np.append(GRID - half_cell, GRID[-1] + half_cell)
    mass_below = np.append(0.0, np.cumsum(density))
    below_low, below_high = np.interp([low, high], edges, mass_below)
    return float(below_high - below_low)


class Votes(NamedTuple):
    """Chance that a detector's box is a car, by its score.

    ``research/training/fusion`` fits it on images of known scale.

    Attributes:
        share_at_zero: log odds that a box of score 0 is a car; in a new place they are lower than
            where the detector was trained.
        share_slope: increase of these log odds from score 0 to 1.
    """

    share_at_zero: float
    share_slope: float

    def log_odds(self, scores: ArrayLike) -> NDArray[np.float64]:
        """Compute the log odds that each box is a car from its score, in steps of a quarter."""
        values = np.asarray(scores, dtype=np.float64)
        log_odds = self.share_at_zero + self.share_slope * values
        limited = np.clip(log_odds, _MIN_LOG_ODDS, _MAX_LOG_ODDS)
        return np.round(limited / _LOG_ODDS_STEP) * _LOG_ODDS_STEP

    def expected_cars(self, scores: ArrayLike) -> float:
        """Compute the expected number of cars among boxes of these scores."""
        odds = np.exp(self.log_odds(scores))
        return float((odds / (1.0 + odds)).sum())


UNCALIBRATED = Votes(-4.0, 10.0)
"""Votes of a detector without fitted ones: a box of score 0.4 is a car with even odds, one of 0.9
almost certainly. A choice."""


def vehicle_likelihood(
    lengths_px: ArrayLike,
    scores: ArrayLike,
    lengths_m: ArrayLike,
    votes: Votes,
    log_sds: ArrayLike,
) -> Density:
    """Compute the density of the scale from the votes of all boxes.

    The likelihood of a scale g is the product over boxes of ``1 + o N(log length; log(L / g),
    sd)``. Here o is the odds that a box of its score is a car, relative to a density of 1 per unit
    of log length for other things.

    Args:
        lengths_px: ``[n]`` pixels of the full image.
        scores: ``[n]`` detection scores.
        lengths_m: ``[n]`` or one for all, ``L``: lengths in metres if the boxes are cars.
        votes: votes of the detector.
        log_sds: ``[n]`` or one for all, standard deviations of the logs of both lengths.

    Returns:
        ``[g]`` probabilities; the flat density without boxes.
    """
    lengths = np.asarray(lengths_px, dtype=np.float64)
    if len(lengths) == 0:
        return flat()
    # The scale at which each box would have its length in metres, as a cell of the grid.
    log_scales = np.log(np.asarray(lengths_m) / lengths)
    n_cells = len(GRID)
    positions = (log_scales - GRID[0]) / LOG_STEP
    cells = np.rint(positions).astype(np.intp)
    inside = (cells >= 0) & (cells < n_cells)
    log_odds = votes.log_odds(scores)
    box_log_sds = np.broadcast_to(log_sds, lengths.shape)
    sd_steps = np.round(box_log_sds / _SD_STEP)
    spreads = np.maximum(sd_steps, 1) * _SD_STEP

    # Boxes of equal odds and spread have the same curve log(1 + o N). The sum of their curves is
    # one convolution of the curve with the number of boxes in each cell.
    log_likelihood = np.zeros(n_cells)
    odds_inside = log_odds[inside].tolist()
    spreads_inside = spreads[inside].tolist()
    bins = set(zip(odds_inside, spreads_inside, strict=True))
    for bin_log_odds, log_sd in sorted(bins):
        in_bin = inside & (log_odds == bin_log_odds) & (spreads == log_sd)
        counts = np.bincount(cells[in_bin], minlength=n_cells).astype(np.float64)
        reach = int(np.ceil(KERNEL_REACH_SDS * log_sd / LOG_STEP))
        deviations = np.arange(-reach, reach + 1) * LOG_STEP / log_sd
        norm = log_sd * np.sqrt(2 * np.pi)
        normal = np.exp(-0.5 * deviations**2) / norm
        curve = np.log1p(np.exp(bin_log_odds) * normal)
        grid_cells = slice(reach, reach + n_cells)
        log_likelihood += np.convolve(counts, curve)[grid_cells]
    relative = log_likelihood - log_likelihood.max()
    return normalised(np.exp(relative))
