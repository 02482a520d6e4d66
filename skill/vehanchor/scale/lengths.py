"""Lengths of vehicles: the fleet among them, the outlier filter, the modal length and its error."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from vehanchor.errors import InvalidParameterError
from vehanchor.scale.defaults import OUTLIER_ALPHA

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import ArrayLike, NDArray

    from vehanchor.scale.defaults import Aggregation

    Lengths: TypeAlias = NDArray[np.float64]
    """``[n]`` lengths of vehicles."""

    Weights: TypeAlias = NDArray[np.float64]
    """``[n]`` weights of vehicles, non-negative."""

    KernelDensity: TypeAlias = NDArray[np.float64]
    """``[g]`` density per pixel at some lengths."""

    IsMember: TypeAlias = NDArray[np.bool_]
    """``[n]`` vehicles that belong to a group."""

    Cells: TypeAlias = NDArray[np.intp]
    """``[n]`` cell of each length."""

# Paper, GSD_max of the resolution guard.
GUARD_GSD_M_PER_PX = 0.3
# Paper, section III-C: with fewer vehicles the median is used.
MIN_KDE_VEHICLES = 5
# Lengths of a fleet lie this close to their modal length, as in the paper's outlier filter.
GROUP_LOG_REACH = math.log(OUTLIER_ALPHA)
# More than the spread of a fleet (0.09) and of the measurement (0.05 to 0.1) together.
_GROUP_LOG_BANDWIDTH = 0.15
_GROUP_LOG_STEP = 0.01
# Step of the grid, in bandwidths; the maximum is then refined between grid points.
_GRID_STEP = 0.2
# A peak may be the highest if its grid point has this share of the highest grid point: a peak lies
# up to a tenth of a bandwidth beside its grid point.
_MAY_BE_HIGHEST = 0.98
# Bandwidth of the weighted density over Scott's. On the train split 1.5 to 3 do alike; with 1 the
# mode jumps between peaks.
_WEIGHTED_SMOOTHING = 2.0
# Some models give scores of 0.
MIN_SCORE = 1e-3
_BOOTSTRAP_REPLICATES = 400
_BOOTSTRAP_SEED = 20260
# Error of an estimate from one car, false alarms included, fitted on the held-out tenth.
_FLEET_LOG_SD = 0.40
# Values per block of a kernel density: 32 MB.
_BLOCK_VALUES = 4_000_000
# Standard deviations to either end of a 95 % interval.
Z95 = 1.959963984540054


class Interval(NamedTuple):
    """95 % interval."""

    low: float
    high: float

    def with_others(self, others: Iterable[Interval | None]) -> Interval:
        """Extend the interval to cover others; None covers nothing."""
        low, high = self
        for other in others:
            if other is not None:
                low = min(low, other.low)
                high = max(high, other.high)
        return Interval(low, high)


class Spread(NamedTuple):
    """Uncertainty of a positive quantity: standard deviations of its log.

    The interval of a scale is often skewed. A symmetric standard deviation would move both of its
    ends, so a distance would contradict the scale that it rests on. Errors of other sources are
    added to each side.

    Attributes:
        below: towards smaller values.
        above: towards larger values.
    """

    below: float = 0.0
    above: float = 0.0

    @classmethod
    def of_interval(cls, value: float | None, low: float | None, high: float | None) -> Spread:
        """Convert a 95 % interval around a value.

        Both sides are 0 without an interval. A side is 0 if the value lies at or beyond that end.
        """
        if not (value and low and high):
            return cls()
        log_below = max(math.log(value / low), 0.0)
        log_above = max(math.log(high / value), 0.0)
        return cls(log_below / Z95, log_above / Z95)

    def times(self, factor: float) -> Spread:
        """Return the spread of a power of the quantity: its relative error times a factor."""
        return Spread(self.below * factor, self.above * factor)

    def plus(self, log_sd: float) -> Spread:
        """Add an independent symmetric error to each side."""
        below = math.hypot(self.below, log_sd)
        above = math.hypot(self.above, log_sd)
        return Spread(below, above)

    def around(self, value: float) -> Interval:
        """Return the 95 % interval around a value."""
        low = value * math.exp(-Z95 * self.below)
        high = value * math.exp(Z95 * self.above)
        return Interval(low, high)


def dominant_group(lengths: ArrayLike, weights: ArrayLike) -> tuple[IsMember, float]:
    """Split lengths of any scale into the fleet with the largest weight and the rest.

    A search over scales finds car-shaped objects of every size. Cars of one image lie within a
    factor of 1.5 of their modal length. The dominant group is therefore all lengths within that
    factor of the strongest mode of the weighted density of log length (Gaussian kernel, 0.15). The
    strongest mode of the remaining lengths is its rival.

    Args:
        lengths: ``[n]`` pixels, n >= 1.
        weights: ``[n]`` evidence that each is a car, non-negative, not all zero.

    Returns:
        ``[n]`` bool, members of the dominant group; and the weight of its rival over its own, 0
        without any. Of two equal groups the one with shorter lengths wins.
    """
    log_lengths = np.log(np.asarray(lengths, dtype=np.float64))
    shares = _normalised(log_lengths, weights)
    from_shortest = log_lengths - log_lengths.min()
    cells = np.rint(from_shortest / _GROUP_LOG_STEP).astype(np.intp)

    everything = np.ones(len(log_lengths), dtype=bool)
    members = _near_strongest_mode(cells, shares, everything)
    if members.all():
        return members, 0.0
    rivals = _near_strongest_mode(cells, shares, ~members) & ~members
    weight = shares[members].sum()
    rival_weight = shares[rivals].sum()
    return members, float(rival_weight / weight)


def _near_strongest_mode(cells: Cells, shares: Weights, voting: IsMember) -> IsMember:
    """Select all lengths within a factor of 1.5 of the strongest mode of the voting ones.

    Args:
        cells: ``[n]`` cells of the log lengths.
        shares: ``[n]`` weights.
        voting: ``[n]`` bool, lengths that make the density.

    Returns:
        ``[n]`` bool.
    """
    # The kernel density on the cells: their weights, convolved with a Gaussian of four sigmas.
    reach = round(4 * _GROUP_LOG_BANDWIDTH / _GROUP_LOG_STEP)
    offsets = np.arange(-reach, reach + 1) * _GROUP_LOG_STEP
    deviations = offsets / _GROUP_LOG_BANDWIDTH
    kernel = np.exp(-0.5 * deviations**2)
    n_cells = int(cells.max()) + 1
    mass = np.bincount(cells[voting], weights=shares[voting], minlength=n_cells)
    convolved = np.convolve(mass, kernel)
    density = convolved[reach : reach + n_cells]
    # The first of equal maxima, whatever the rounding.
    is_maximum = density > density.max() * (1 - 1e-9)
    mode = int(np.argmax(is_maximum))
    log_distances = np.abs(cells - mode) * _GROUP_LOG_STEP
    return np.asarray(log_distances <= GROUP_LOG_REACH + 1e-9)


def inlier_mask(lengths: ArrayLike, alpha: float | None = OUTLIER_ALPHA) -> IsMember:
    """Keep ``P_i <= alpha * median(P)`` (paper, equation 2), which drops long outliers only.

    Args:
        lengths: ``[n]`` pixels.
        alpha: factor; None keeps all lengths.

    Returns:
        ``[n]`` bool.
    """
    values = np.asarray(lengths, dtype=np.float64)
    if alpha is None or len(values) == 0:
        return np.ones(len(values), dtype=bool)
    longest = alpha * np.median(values)
    return np.asarray(values <= longest)


def scott_bandwidth(values: Lengths, weights: Weights) -> float:
    """Compute Scott's bandwidth with the effective sample size, as ``scipy.stats.gaussian_kde``.

    Args:
        values: ``[n]``.
        weights: ``[n]`` non-negative, their sum 1.

    Returns:
        The standard deviation of the kernel, in the unit of the values; 0 without spread.
    """
    sum_of_squares = np.sum(weights**2)
    n_effective = 1.0 / sum_of_squares
    if len(values) < 2 or n_effective <= 1.0 + 1e-12:
        return 0.0
    mean = np.sum(weights * values)
    squared_deviations = weights * (values - mean) ** 2
    variance = np.sum(squared_deviations) / (1.0 - sum_of_squares)
    sd = np.sqrt(max(variance, 0.0))
    return float(sd * n_effective ** (-0.2))


def _normalised(values: Lengths, weights: ArrayLike | None) -> Weights:
    """Scale the weights ``[n]`` of values to the sum 1; None gives equal weights."""
    shares = np.ones(len(values))
    if weights is not None:
        shares = np.asarray(weights, dtype=np.float64)
    fits = shares.shape == values.shape and np.isfinite(shares).all()
    if not fits or (shares < 0).any() or shares.sum() <= 0:
        raise InvalidParameterError(
            "weights must be finite, non-negative, not all zero, and as many as the lengths"
        )
    return np.asarray(shares / shares.sum())


def kde_density(
    at: ArrayLike,
    lengths: ArrayLike,
    weights: ArrayLike | None = None,
    *,
    smoothing: float = 1.0,
) -> KernelDensity:
    """Compute the Gaussian kernel density of lengths (paper, equation 3).

    With a smoothing of 1, it equals ``scipy.stats.gaussian_kde``.

    Args:
        at: ``[g]`` points, pixels.
        lengths: ``[n]`` pixels, with some spread.
        weights: ``[n]`` non-negative, or None for equal ones.
        smoothing: factor on Scott's bandwidth.

    Returns:
        ``[g]`` density per pixel; all zero if the lengths have no spread.
    """
    values = np.asarray(lengths, dtype=np.float64)
    points = np.asarray(at, dtype=np.float64)
    shares = _normalised(values, weights)
    bandwidth = smoothing * scott_bandwidth(values, shares)
    if bandwidth == 0.0:
        return np.zeros(len(points))
    mixture = _NormalMixture(values, shares, bandwidth)
    return mixture.density_at(points)


class _NormalMixture(NamedTuple):
    """Kernel density: a mixture of normal densities of one width.

    Attributes:
        values: ``[n]`` means, the lengths.
        shares: ``[n]`` weights, their sum 1 for all lengths.
        bandwidth: standard deviation of each.
    """

    values: Lengths
    shares: Weights
    bandwidth: float

    def density_at(self, points: Lengths) -> KernelDensity:
        """Compute the density at points ``[g]``, in blocks that bound the memory."""
        density = np.empty(len(points))
        points_at_once = max(1, _BLOCK_VALUES // max(1, len(self.values)))
        for start in range(0, len(points), points_at_once):
            block = slice(start, start + points_at_once)
            offsets = points[block, None] - self.values[None, :]
            deviations = offsets / self.bandwidth
            kernels = np.exp(-0.5 * deviations * deviations)
            density[block] = kernels @ self.shares
        norm = self.bandwidth * np.sqrt(2 * np.pi)
        return np.asarray(density / norm)

    def near(self, point: float) -> _NormalMixture:
        """Leave out the normal densities that are negligible around a point."""
        # Beyond 12 bandwidths a Gaussian adds less than 1e-31.
        is_near = np.abs(self.values - point) < 12 * self.bandwidth
        return _NormalMixture(self.values[is_near], self.shares[is_near], self.bandwidth)


def kde_mode(
    lengths: ArrayLike, weights: ArrayLike | None = None, *, smoothing: float = 1.0
) -> float:
    """Find the mode of the kernel density, ``argmax f(x)`` (paper, equation 3), within 1e-3 px.

    The mode is searched on a grid of a fifth of a bandwidth. Golden-section search refines each
    peak of the grid that may be the highest.

    Args:
        lengths: ``[n]`` pixels, n >= 1.
        weights: ``[n]`` non-negative, not all zero; None for equal ones.
        smoothing: factor on Scott's bandwidth.

    Returns:
        The modal length in pixels; the (weighted) mean if there is no spread.

    Raises:
        InvalidParameterError: there are no lengths, or the weights are unusable.
    """
    values = np.asarray(lengths, dtype=np.float64)
    shares = _normalised(values, weights)
    low = float(values.min())
    high = float(values.max())
    bandwidth = smoothing * scott_bandwidth(values, shares)
    negligible = 1e-9 * high
    if high - low <= negligible or bandwidth <= negligible:
        return float(np.sum(shares * values))

    step = _GRID_STEP * bandwidth
    n_steps = int(np.ceil((high - low) / step))
    points = np.linspace(low, high, n_steps + 2)
    mixture = _NormalMixture(values, shares, bandwidth)
    density = mixture.density_at(points)

    # A peak of the grid is at least as high as its left neighbour and higher than its right one.
    padded = np.pad(density, 1, constant_values=-np.inf)
    left = padded[:-2]
    right = padded[2:]
    is_peak = (density >= left) & (density > right)
    may_be_highest = density >= _MAY_BE_HIGHEST * density.max()
    peaks = np.flatnonzero(is_peak & may_be_highest).tolist()
    modes = [_refined_peak(mixture, points, peak) for peak in peaks]
    heights = mixture.density_at(np.array(modes))
    highest = np.argmax(heights)
    return float(modes[highest])


def _refined_peak(mixture: _NormalMixture, points: Lengths, index: int) -> float:
    """Refine the peak of the density beside a point of the grid, to 1e-5 px.

    Args:
        mixture: the density.
        points: ``[g]`` grid.
        index: index of the highest point of this peak.
    """
    last = len(points) - 1
    left = points[max(index - 1, 0)]
    right = points[min(index + 1, last)]
    near = mixture.near(points[index])
    # Golden-section search: the part beside the lower of two inner points is dropped.
    golden = (np.sqrt(5) - 1) / 2
    while right - left > 1e-5:
        step = golden * (right - left)
        inner_left = right - step
        inner_right = left + step
        height_left, height_right = near.density_at(np.array([inner_left, inner_right]))
        if height_left >= height_right:
            right = inner_right
        else:
            left = inner_left
    return float((left + right) / 2)


def kernel_weights(
    lengths: ArrayLike, scores: ArrayLike, aggregation: Aggregation
) -> tuple[Weights, float]:
    """Choose the vehicles' weights, and the factor on the bandwidth of their density.

    ``weighted_kde`` uses ``score^2 * length`` and 2: most false alarms, such as roof windows and
    bushes, have low scores and short boxes, and so do half-hidden cars.

    Args:
        lengths: ``[n]`` pixels.
        scores: ``[n]`` detection scores, 0..1; used by ``weighted_kde``.
        aggregation: see ``modal_length``.

    Returns:
        ``[n]`` positive weights, and the factor on Scott's bandwidth.
    """
    values = np.asarray(lengths, dtype=np.float64)
    if aggregation != "weighted_kde":
        return np.ones(len(values)), 1.0
    score = np.asarray(scores, dtype=np.float64)
    score = np.maximum(score, MIN_SCORE)
    weights = np.asarray(score**2 * values)
    return weights, _WEIGHTED_SMOOTHING


def modal_density(
    at: ArrayLike, lengths: ArrayLike, scores: ArrayLike, aggregation: Aggregation
) -> KernelDensity:
    """Compute the density whose mode is ``modal_length``; the paper's for median and mean.

    Args:
        at: ``[g]`` points, pixels.
        lengths: ``[n]`` pixels.
        scores: ``[n]`` detection scores.
        aggregation: see ``modal_length``.

    Returns:
        ``[g]`` density per pixel; all zero if the lengths have no spread.
    """
    weights, smoothing = kernel_weights(lengths, scores, aggregation)
    return kde_density(at, lengths, weights, smoothing=smoothing)


def modal_length(
    lengths: ArrayLike, scores: ArrayLike, aggregation: Aggregation = "kde"
) -> tuple[float, Aggregation]:
    """Compute the modal length of vehicles, ``P_mode``.

    Args:
        lengths: ``[n]`` pixels, n >= 1, outliers already removed.
        scores: ``[n]`` detection scores, for ``weighted_kde``.
        aggregation: ``kde`` (the paper's), ``weighted_kde``, ``median`` or ``mean``. The weighted
            KDE uses the weights ``score^2 * length`` and twice the bandwidth: false alarms and
            half-hidden cars move it less. Both KDEs fall back to the median below 5 lengths.

    Returns:
        Length in pixels, and the aggregation that was used.
    """
    values = np.asarray(lengths, dtype=np.float64)
    if aggregation in ("kde", "weighted_kde") and len(values) < MIN_KDE_VEHICLES:
        aggregation = "median"
    if aggregation == "median":
        return float(np.median(values)), aggregation
    if aggregation == "mean":
        return float(np.mean(values)), aggregation
    weights, smoothing = kernel_weights(values, scores, aggregation)
    return kde_mode(values, weights, smoothing=smoothing), aggregation


def resampled_modes(
    values: Lengths, weights: Weights, smoothing: float, block: NDArray[np.intp] | None = None
) -> Lengths:
    """Compute the KDE modes of 400 resamples, from a fixed seed.

    Lengths are binned to a fifth of a bandwidth, so that the cost hardly depends on their number.

    Args:
        values: ``[n]`` lengths.
        weights: ``[n]``.
        smoothing: factor on Scott's bandwidth.
        block: ``[n]`` number of each length's block, 0 and up; blocks are drawn whole. None draws
            single lengths.

    Returns:
        ``[400]`` modal lengths.
    """
    shares = weights / weights.sum()
    bandwidth = smoothing * scott_bandwidth(values, shares)
    low = float(values.min())
    high = float(values.max())
    if bandwidth <= 1e-9 * high:
        mode = kde_mode(values, weights, smoothing=smoothing)
        return np.full(_BOOTSTRAP_REPLICATES, mode)
    step = _GRID_STEP * bandwidth
    n_steps = np.ceil((high - low) / step)
    n_cells = int(np.clip(n_steps, 8, 1024))
    ends = (low, high)
    counts, edges = np.histogram(values, bins=n_cells, range=ends)
    if block is None:
        mass, _ = np.histogram(values, bins=n_cells, range=ends, weights=weights)
        mean_weights = mass / np.maximum(counts, 1)
        masses = _resampled_lengths(counts, mean_weights)
    else:
        cells = np.searchsorted(edges, values, side="right") - 1
        # The longest length lies on the last edge.
        cells = np.minimum(cells, n_cells - 1)
        masses = _resampled_blocks(cells, weights, n_cells, block=block)

    # Each resample's density at the centres of the cells is its masses times the kernel.
    centres = (edges[:-1] + edges[1:]) / 2
    offsets = centres[:, None] - centres[None, :]
    deviations = offsets / bandwidth
    kernel = np.exp(-0.5 * deviations**2)
    densities = masses @ kernel
    highest = np.argmax(densities, axis=1)
    return np.asarray(centres[highest])


def _resampled_lengths(counts: NDArray[np.intp], mean_weights: Weights) -> Weights:
    """Draw single lengths with replacement.

    Args:
        counts: ``[cells]`` number of lengths by cell.
        mean_weights: ``[cells]`` mean weight of the lengths by cell.

    Returns:
        ``[400, cells]`` weights drawn.
    """
    rng = np.random.default_rng(_BOOTSTRAP_SEED)
    n = int(counts.sum())
    drawn = rng.multinomial(n, counts / n, size=_BOOTSTRAP_REPLICATES)
    return np.asarray(drawn * mean_weights)


def _resampled_blocks(
    cells: Cells, weights: Weights, n_cells: int, *, block: NDArray[np.intp]
) -> Weights:
    """Draw whole blocks with replacement.

    Args:
        cells: ``[n]`` cell of each length.
        weights: ``[n]`` weight of each length.
        n_cells: number of cells.
        block: ``[n]`` block of each length.

    Returns:
        ``[400, cells]`` weights drawn.
    """
    rng = np.random.default_rng(_BOOTSTRAP_SEED)
    n_blocks = int(block.max()) + 1
    chances = np.full(n_blocks, 1 / n_blocks)
    times_drawn = rng.multinomial(n_blocks, chances, size=_BOOTSTRAP_REPLICATES)
    masses = []
    for times in times_drawn:
        drawn_weights = weights * times[block]
        masses.append(np.bincount(cells, drawn_weights, n_cells))
    return np.array(masses)


def statistical_log_sds(
    lengths: ArrayLike, scores: ArrayLike, mode_px: float, aggregation: Aggregation
) -> tuple[float, float]:
    """Compute the part of the scale's uncertainty that more vehicles reduce.

    Args:
        lengths: ``[n]`` lengths behind ``mode_px``, pixels, n >= 1.
        scores: ``[n]`` detection scores.
        mode_px: ``P_mode``.
        aggregation: its statistic; ``weighted_kde`` uses the scores.

    Returns:
        Log standard deviations of two independent causes: the mode under resampling, and the
        fleet's own spread divided by the root of the number of cars. The second one stays large if
        a few cars agree by chance.
    """
    values = np.asarray(lengths, dtype=np.float64)
    weights, smoothing = kernel_weights(values, scores, aggregation)
    resampling = 0.0
    if len(values) >= MIN_KDE_VEHICLES:
        modes_px = resampled_modes(values, weights, smoothing)
        log_errors = np.log(modes_px / mode_px)
        resampling = float(np.sqrt(np.mean(log_errors**2)))
    fleet = _FLEET_LOG_SD / np.sqrt(len(values))
    return resampling, fleet


def guard_length(reference_length_m: float, min_length_px: float = 0.0) -> float:
    """Compute ``P_thresh`` of the resolution guard (paper, equation 6).

    Args:
        reference_length_m: ``L_ref``.
        min_length_px: shortest length that the model measures without bias; a lower limit.

    Returns:
        Pixels: ``max(L_ref / 0.3, min_length_px)``.
    """
    return max(reference_length_m / GUARD_GSD_M_PER_PX, min_length_px)
