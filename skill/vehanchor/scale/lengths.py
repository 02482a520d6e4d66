"""Vehicle lengths in pixels to metres per pixel: outlier filter, modal length, scale and interval."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.errors import InvalidParameterError
from vehanchor.scale.defaults import OUTLIER_ALPHA

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from vehanchor.scale.defaults import Aggregation

GUARD_GSD_M_PER_PX = 0.3  # paper, GSD_max
MIN_KDE_VEHICLES = 5  # paper, section III-C: with fewer vehicles the median is used
# of a fleet around its modal length, as in the paper's outlier filter
GROUP_LOG_REACH = math.log(OUTLIER_ALPHA)
# more than the spread of a fleet (0.09) and of the measurement (0.05 to 0.1) together
_GROUP_LOG_BANDWIDTH = 0.15
_GROUP_LOG_STEP = 0.01
_GRID_STEP = 0.2  # of a bandwidth; the maximum is then refined between grid points
# of the highest point of the grid, which lies up to a tenth of a bandwidth beside its peak
_MAY_BE_HIGHEST = 0.98
# of Scott's bandwidth; on the train split 1.5 to 3 do alike, 1 jumps between peaks
_WEIGHTED_SMOOTHING = 2.0
MIN_SCORE = 1e-3  # some models give scores of 0
_BOOTSTRAP_REPLICATES = 400
_BOOTSTRAP_SEED = 20260
# error of an estimate from one car, false alarms included, fitted on the held-out tenth
_FLEET_LOG_SD = 0.40
Z95 = 1.959963984540054  # standard deviations to either end of a 95 % interval


class Interval(NamedTuple):
    """95 % interval."""

    low: float
    high: float


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
        """Convert a 95 % interval; without one, both sides are 0; with a value at an end, that side is."""
        if not (value and low and high):
            return cls()
        return cls(max(math.log(value / low), 0.0) / Z95, max(math.log(high / value), 0.0) / Z95)

    def times(self, factor: float) -> Spread:
        """Return the spread of a power of the quantity, or of the quantity with its relative error multiplied."""
        return Spread(self.below * factor, self.above * factor)

    def plus(self, log_sd: float) -> Spread:
        """Add an independent symmetric error to each side."""
        return Spread(math.hypot(self.below, log_sd), math.hypot(self.above, log_sd))

    def around(self, value: float) -> Interval:
        """Return the 95 % interval around a value."""
        return Interval(value * math.exp(-Z95 * self.below), value * math.exp(Z95 * self.above))


def dominant_group(
    lengths: ArrayLike, weights: ArrayLike, stated: ArrayLike | None = None
) -> tuple[NDArray[np.bool_], float]:
    """Split lengths of any scale into the fleet with the largest weight and the rest.

    A search over scales finds car-shaped objects of every size. Cars of one image lie within a
    factor of 1.5 of their modal length. The dominant group is therefore all lengths within that
    factor of the strongest mode of the weighted density of log length (Gaussian kernel, 0.15). The
    strongest mode of the remaining lengths is its rival.

    Args:
        lengths: ``[n]`` pixels, n >= 1.
        weights: ``[n]`` evidence that each is a car, non-negative, not all zero.
        stated: ``[n]`` bool, cars by the caller's word; if any, their mode alone is the group's
            centre.

    Returns:
        ``[n]`` bool, members of the dominant group; and the weight of its rival over its own, 0
        without any. Of two equal groups the one with shorter lengths wins.
    """
    logs = np.log(np.asarray(lengths, dtype=np.float64))
    weight = _normalised(logs, weights)
    cells = np.rint((logs - logs.min()) / _GROUP_LOG_STEP).astype(np.intp)
    reach = round(4 * _GROUP_LOG_BANDWIDTH / _GROUP_LOG_STEP)
    kernel = np.exp(
        -0.5 * (np.arange(-reach, reach + 1) * _GROUP_LOG_STEP / _GROUP_LOG_BANDWIDTH) ** 2
    )

    told = np.zeros(len(logs), dtype=bool) if stated is None else np.asarray(stated, dtype=bool)

    def strongest(voting: NDArray[np.bool_]) -> NDArray[np.bool_]:
        mass = np.bincount(cells[voting], weights=weight[voting], minlength=int(cells.max()) + 1)
        density = np.convolve(mass, kernel)[reach : reach + len(mass)]
        mode = int(np.argmax(density > density.max() * (1 - 1e-9)))
        return np.asarray(np.abs(cells - mode) * _GROUP_LOG_STEP <= GROUP_LOG_REACH + 1e-9)

    members = strongest(told if told.any() else np.ones(len(logs), dtype=bool))
    if members.all():
        return members, 0.0
    rival = strongest(~members) & ~members
    return members, float(weight[rival].sum() / weight[members].sum())


def inlier_mask(lengths: ArrayLike, alpha: float | None = OUTLIER_ALPHA) -> NDArray[np.bool_]:
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
    return np.asarray(values <= alpha * np.median(values))


def scott_bandwidth(values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Compute Scott's bandwidth with the effective sample size, as ``scipy.stats.gaussian_kde``; 0 without spread.

    Args:
        values: ``[n]``.
        weights: ``[n]`` non-negative, their sum 1.

    Returns:
        The standard deviation of the kernel, in the unit of the values.
    """
    effective = 1.0 / np.sum(weights**2)
    if len(values) < 2 or effective <= 1.0 + 1e-12:
        return 0.0
    mean = np.sum(weights * values)
    variance = np.sum(weights * (values - mean) ** 2) / (1.0 - np.sum(weights**2))
    return float(np.sqrt(max(variance, 0.0)) * effective ** (-0.2))


def _normalised(values: NDArray[np.float64], weights: ArrayLike | None) -> NDArray[np.float64]:
    raw = np.ones(len(values)) if weights is None else np.asarray(weights, dtype=np.float64)
    if raw.shape != values.shape or not np.isfinite(raw).all() or (raw < 0).any() or raw.sum() <= 0:
        raise InvalidParameterError(
            "weights must be finite, non-negative, not all zero, and as many as the lengths"
        )
    return np.asarray(raw / raw.sum())


def kde_density(
    at: ArrayLike, lengths: ArrayLike, weights: ArrayLike | None = None, *, smoothing: float = 1.0
) -> NDArray[np.float64]:
    """Compute the Gaussian kernel density of lengths (paper, equation 3), equal to ``scipy.stats.gaussian_kde``.

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
    share = _normalised(values, weights)
    bandwidth = smoothing * scott_bandwidth(values, share)
    if bandwidth == 0.0:
        return np.zeros(len(points))
    return _mixture(points, values, share=share, bandwidth=bandwidth)


def _mixture(
    points: NDArray[np.float64],
    values: NDArray[np.float64],
    share: NDArray[np.float64],
    bandwidth: float,
) -> NDArray[np.float64]:
    out = np.empty(len(points))
    block = max(1, 4_000_000 // max(1, len(values)))  # 32 MB a block
    for start in range(0, len(points), block):
        z = (points[start : start + block, None] - values[None, :]) / bandwidth
        out[start : start + block] = np.exp(-0.5 * z * z) @ share
    return np.asarray(out / (bandwidth * np.sqrt(2 * np.pi)))


def kde_mode(
    lengths: ArrayLike, weights: ArrayLike | None = None, *, smoothing: float = 1.0
) -> float:
    """Find the mode of the kernel density estimate, ``argmax f(x)`` (paper, equation 3), to better than 1e-3 px.

    The mode is searched on a grid of a fifth of a bandwidth. Golden-section search refines each
    peak of the grid that may be the highest.

    Args:
        lengths: ``[n]`` pixels, n >= 1.
        weights: ``[n]`` non-negative, not all zero; None for equal ones.
        smoothing: factor on Scott's bandwidth.

    Returns:
        The modal length in pixels; the (weighted) mean if there is no spread.

    Raises:
        InvalidParameterError: no lengths, or unusable weights.
    """
    values = np.asarray(lengths, dtype=np.float64)
    share = _normalised(values, weights)
    low = float(values.min())
    high = float(values.max())
    bandwidth = smoothing * scott_bandwidth(values, share)
    if high - low <= 1e-9 * high or bandwidth <= 1e-9 * high:
        return float(np.sum(share * values))
    points = np.linspace(low, high, int(np.ceil((high - low) / (_GRID_STEP * bandwidth))) + 2)
    density = _mixture(points, values, share=share, bandwidth=bandwidth)
    padded = np.pad(density, 1, constant_values=-np.inf)
    peaks = (
        (density >= padded[:-2])
        & (density > padded[2:])
        & (density >= _MAY_BE_HIGHEST * density.max())
    )
    modes = np.array(
        [
            _peak(points, int(top), values=values, share=share, bandwidth=bandwidth)
            for top in np.flatnonzero(peaks)
        ]
    )
    return float(modes[np.argmax(_mixture(modes, values, share=share, bandwidth=bandwidth))])


def _peak(
    points: NDArray[np.float64],
    top: int,
    values: NDArray[np.float64],
    share: NDArray[np.float64],
    bandwidth: float,
) -> float:
    """Refine the peak of the density beside a point of the grid, to 1e-5 px."""
    left = points[max(top - 1, 0)]
    right = points[min(top + 1, len(points) - 1)]
    near = np.abs(values - points[top]) < 12 * bandwidth  # beyond, a Gaussian adds less than 1e-31
    local = values[near]
    local_share = share[near]
    golden = (np.sqrt(5) - 1) / 2
    while right - left > 1e-5:
        inner = np.array([right - golden * (right - left), left + golden * (right - left)])
        first, second = _mixture(inner, local, share=local_share, bandwidth=bandwidth)
        left, right = (left, inner[1]) if first >= second else (inner[0], right)
    return float((left + right) / 2)


def kernel_weights(
    lengths: ArrayLike, scores: ArrayLike, aggregation: Aggregation
) -> tuple[NDArray[np.float64], float]:
    """Choose the vehicles' weights and the factor on the bandwidth: ``score^2 * length`` and 2 for ``weighted_kde``.

    Most false alarms, such as roof windows and bushes, have low scores and short boxes, as have
    half-hidden cars.

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
    score = np.maximum(np.asarray(scores, dtype=np.float64), MIN_SCORE)
    return np.asarray(score**2 * values), _WEIGHTED_SMOOTHING


def modal_density(
    at: ArrayLike, lengths: ArrayLike, scores: ArrayLike, aggregation: Aggregation
) -> NDArray[np.float64]:
    """Compute the density whose mode is ``modal_length``; for ``median`` and ``mean`` the paper's density.

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
    if aggregation in ("median", "mean"):
        return float(np.median(values) if aggregation == "median" else np.mean(values)), aggregation
    weights, smoothing = kernel_weights(values, scores, aggregation)
    return kde_mode(values, weights, smoothing=smoothing), aggregation


def resampled_modes(
    values: NDArray[np.float64],
    weights: NDArray[np.float64],
    smoothing: float,
    block: NDArray[np.intp] | None = None,
) -> NDArray[np.float64]:
    """Compute the KDE modes of 400 resamples, from a fixed seed.

    Lengths are binned to a fifth of a bandwidth, so that the cost hardly depends on their number.

    Args:
        values: ``[n]`` lengths.
        weights: ``[n]``.
        smoothing: factor on Scott's bandwidth.
        block: ``[n]`` number of each length's block, 0 and up; blocks are drawn whole. None draws
            single lengths.
    """
    bandwidth = smoothing * scott_bandwidth(values, weights / weights.sum())
    low = float(values.min())
    high = float(values.max())
    if bandwidth <= 1e-9 * high:
        return np.full(_BOOTSTRAP_REPLICATES, kde_mode(values, weights, smoothing=smoothing))
    cells = int(np.clip(np.ceil((high - low) / (_GRID_STEP * bandwidth)), 8, 1024))
    counts, edges = np.histogram(values, bins=cells, range=(low, high))
    mass, _ = np.histogram(values, bins=cells, range=(low, high), weights=weights)
    centres = (edges[:-1] + edges[1:]) / 2
    kernel = np.exp(-0.5 * ((centres[:, None] - centres[None, :]) / bandwidth) ** 2)
    rng = np.random.default_rng(_BOOTSTRAP_SEED)
    if block is None:
        each = mass / np.maximum(counts, 1)  # mean weight of a cell's vehicles
        drawn = (
            rng.multinomial(len(values), counts / counts.sum(), size=_BOOTSTRAP_REPLICATES) * each
        )
    else:
        cell = np.minimum(np.searchsorted(edges, values, side="right") - 1, cells - 1)
        n = int(block.max()) + 1
        times = rng.multinomial(n, np.full(n, 1 / n), size=_BOOTSTRAP_REPLICATES)
        drawn = np.array([np.bincount(cell, weights * each[block], cells) for each in times])
    return np.asarray(centres[np.argmax(drawn @ kernel, axis=1)])


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
        resampling = float(
            np.sqrt(np.mean(np.log(resampled_modes(values, weights, smoothing) / mode_px) ** 2))
        )
    return resampling, _FLEET_LOG_SD / np.sqrt(len(values))


def guard_length(reference_length_m: float, min_length_px: float = 0.0) -> float:
    """Compute ``P_thresh`` of the resolution guard (paper, equation 6), at least the model's own limit.

    Args:
        reference_length_m: ``L_ref``.
        min_length_px: shortest length that the model measures without bias.

    Returns:
        Pixels: ``max(L_ref / 0.3, min_length_px)``.
    """
    return max(reference_length_m / GUARD_GSD_M_PER_PX, min_length_px)
