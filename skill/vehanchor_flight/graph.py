"""Graph of a flight: scales from the ratios of overlapping photographs and from their own evidence.

The fit minimises the sum of three terms:

    links:         rho((x_i + g_i p_ij - x_j - g_j p_ji - r_ij) / s_ij)
    own evidence:  rho((x_i - u_i) / t_i)
    gradients:     (g_i / t_g)^2

x_i is the log scale at the centre of photograph i, and g_i its gradient. r_ij is the measured log
ratio of the scales of i and j, and u_i the log scale by the photograph's own evidence; s_ij, t_i
and t_g are standard deviations. The gradient is needed because a tilt of a few degrees changes the
scale from edge to edge, and photographs overlap at their edges (at p_ij).

rho is the Geman-McClure loss, which ignores outliers. Graduated non-convexity (Yang et al.,
"Graduated Non-Convexity for Robust Spatial Perception", 2020) goes from the square loss to rho.
Each step is a sparse least-squares problem, so that the result does not depend on a start. The
flight's own residuals give the real spread of the ratios, which includes relief and tilt.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import compress
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Indices: TypeAlias = NDArray[np.intp]
    """Indices of photographs."""

    Logs: TypeAlias = NDArray[np.float64]
    """Natural logs of scales in metres per pixel, or of ratios of scales."""

    Sds: TypeAlias = NDArray[np.float64]
    """Standard deviations of natural logs."""

    Weights: TypeAlias = NDArray[np.float64]
    """Weights of the equations."""

    Matrix: TypeAlias = NDArray[np.float64]
    """Covariance or its inverse."""

    Vectors: TypeAlias = NDArray[np.float64]
    """Vectors x, y: positions from the centre of a photograph, or tilts."""

    Flags: TypeAlias = NDArray[np.bool_]
    """Which of the links have a property."""

_REACH = 3.0  # Scale of the robust loss, in standard deviations.
# A link is dropped if it is off by more than both.
_DROP_SDS = 4.0
_DROP_LOG = 0.12
_ANNEALING_FACTOR = 1.4
_MAX_STEPS = 40
_N_INFLATIONS = 2  # The spread of the ratios is estimated again with the spread found first.
_MAX_INFLATION = 8.0
_GRADIENT_SD = 0.05  # Log of scale from the centre to the edge: a tilt of two to five degrees.
_LOOSE_SD = 3.0  # Of a photograph without evidence: keeps the problem regular.
# Share of the loose prior that the fit uses, so that it does not pull the scales.
_FIT_PRIOR = 1e-3
_MAD_PER_SD = 0.6745  # Median absolute value of a normal distribution over its deviation.
_MIN_TILT_PHOTOGRAPHS = 4
_MIN_TILT_SHARE = 0.5
# Half of the longer side over the focal length, times the tangent of 10 to 52 degrees.
_MIN_TILT_GRADIENT = 0.12
_MAX_TILT_GRADIENT = 0.9
_N_TILT_GRADIENTS = 16
_TILT_DIRECTION_STEP = np.pi / 18
# Nearness is inverse depth, that of a point over that of the centre; at the horizon it is 0.
_MIN_NEARNESS = 0.15


class Link(NamedTuple):
    """Measured ratio of the scales of two photographs.

    Attributes:
        first: index of one.
        second: index of the other.
        log_ratio: log scale of the first less that of the second.
        log_sd: its standard deviation.
        first_at: middle of the overlap in the first, x, y from its centre; 1 is half of the longer
            side.
        second_at: middle of the overlap in the second.
    """

    first: int
    second: int
    log_ratio: float
    log_sd: float
    first_at: tuple[float, float] = (0.0, 0.0)
    second_at: tuple[float, float] = (0.0, 0.0)


class Unary(NamedTuple):
    """Own evidence of a photograph.

    Attributes:
        log_scale: natural log of metres per pixel.
        log_sd: its standard deviation.
    """

    log_scale: float
    log_sd: float


@dataclass(frozen=True, eq=False)
class Subgraph:
    """Photographs that are linked to each other.

    Attributes:
        members: ``[m]`` indices, ascending.
        log_scales: ``[m]`` natural logs of metres per pixel; without evidence up to a constant.
        covariance: ``[m, m]`` covariance of the log scales.
    """

    members: Indices
    log_scales: Logs
    covariance: Matrix

    def sds_from(self, reference: int) -> Sds:
        """Compute the errors of the members' log scales relative to that of the reference.

        Returns:
            ``[m]`` standard deviations.
        """
        variances = np.diag(self.covariance)
        covariances = self.covariance[reference]
        # The variance of a difference is var(a) + var(b) - 2 cov(a, b).
        differences = variances + variances[reference] - 2 * covariances
        differences = np.maximum(differences, 0.0)
        return np.asarray(np.sqrt(differences))


class Solution(NamedTuple):
    """Scales of a flight.

    Attributes:
        components: the largest first, then by the first index.
        residuals: ``[l]`` measured less fitted log ratio of each link.
        used: ``[l]`` bool, links in use.
        inflation: spread of the ratios over their own standard deviations, at least 1.
    """

    components: tuple[Subgraph, ...]
    residuals: Logs
    used: Flags
    inflation: float


def solve(n: int, links: Sequence[Link], unaries: Sequence[Unary | None]) -> Solution:
    """Find the scales that agree with most of the links and the evidence.

    Args:
        n: number of photographs.
        links: measured ratios.
        unaries: ``[n]`` own evidence of each photograph; None without any.

    Returns:
        Components of links that agree, each with its scales, and the residuals of all links.
    """
    stated_sds = np.array([link.log_sd for link in links], dtype=np.float64)
    problem = _Problem(n, links, unaries)
    # The residuals show whether the ratios scatter more than their matches state.
    in_loop = ~_is_dangling(n, links)
    loop_sds = stated_sds[in_loop]
    inflation = 1.0
    for _ in range(_N_INFLATIONS):
        problem.anneal(stated_sds * inflation)
        loop_errors = np.abs(problem.residuals[in_loop])
        if len(loop_errors):
            spread = np.median(loop_errors / loop_sds) / _MAD_PER_SD
            inflation = float(np.clip(spread, 1.0, _MAX_INFLATION))
    sds = stated_sds * inflation
    # The robust loss ignored the outliers; the final fit is without them.
    residuals = problem.residuals
    errors = np.abs(residuals)
    is_improbable = errors > _DROP_SDS * sds
    is_large = errors > _DROP_LOG
    is_outlier = is_improbable & is_large
    used = ~is_outlier
    used_links = list(compress(links, used))
    if is_outlier.any():
        problem = _Problem(n, used_links, unaries)
        problem.anneal(sds[used])
        residuals[used] = problem.residuals
    components = _components(n, used_links, sds=sds[used], problem=problem)
    return Solution(components, residuals, used=used, inflation=inflation)


class _Problem:
    """Robust sparse least-squares problem.

    Its unknowns are ``[n]`` log scales, then ``[n, 2]`` gradients; its equations are those of the
    links, then those of the photographs' own evidence.
    """

    def __init__(
        self,
        n: int,
        links: Sequence[Link],
        unaries: Sequence[Unary | None],
    ) -> None:
        self._n = n
        self._n_links = len(links)
        evident = [index for index, unary in enumerate(unaries) if unary is not None]
        evidence = [unary for unary in unaries if unary is not None]
        self._matrix = _equations(n, links, evident)
        log_ratios = [link.log_ratio for link in links]
        log_scales = [unary.log_scale for unary in evidence]
        self._target = np.concatenate([log_ratios, log_scales])
        self._own_sds = np.array([unary.log_sd for unary in evidence], dtype=np.float64)
        # A weak prior at the middle of the evidence keeps components without evidence regular.
        middle = 0.0
        if log_scales:
            middle = float(np.median(log_scales))
        scale_precision = np.full(n, _FIT_PRIOR / _LOOSE_SD**2)
        gradient_precision = np.full(2 * n, 1 / _GRADIENT_SD**2)
        self._prior = np.concatenate([scale_precision, gradient_precision])
        scale_pull = np.full(n, middle * _FIT_PRIOR / _LOOSE_SD**2)
        gradient_pull = np.zeros(2 * n)
        self._prior_pull = np.concatenate([scale_pull, gradient_pull])
        self._unknowns = np.zeros(3 * n)

    @property
    def scales(self) -> Logs:
        """``[n]`` log scales."""
        return np.asarray(self._unknowns[: self._n])

    @property
    def residuals(self) -> Logs:
        """``[l]`` measured less fitted log ratio of each link."""
        misfits = self._target - self._matrix @ self._unknowns
        return np.asarray(misfits[: self._n_links])

    def anneal(self, link_sds: Sds) -> None:
        """Solve, in steps from the square loss to the robust loss.

        Args:
            link_sds: ``[l]`` standard deviations of the links' log ratios.
        """
        sds = np.concatenate([link_sds, self._own_sds])
        self._solve(np.ones(len(sds)), sds)
        if not len(sds):
            return
        # Graduated non-convexity: the surrogate loss is nearly convex for a large mu, and it is the
        # Geman-McClure loss for mu = 1. The weights are those of Yang et al. (2020), section IV.
        squares = self._scaled_residuals(sds) ** 2
        largest = float(squares.max())
        mu = max(1.0, 2 * largest / _REACH**2)
        for _ in range(_MAX_STEPS):
            squares = self._scaled_residuals(sds) ** 2
            limit = mu * _REACH**2
            weights = (limit / (squares + limit)) ** 2
            self._solve(weights, sds)
            if mu == 1.0:
                break
            mu = max(1.0, mu / _ANNEALING_FACTOR)

    def information(self, members: Indices, link_sds: Sds) -> Matrix:
        """Compute the inverse covariance of some photographs' unknowns.

        Args:
            members: ``[m]`` indices of the photographs.
            link_sds: ``[l]`` standard deviations of the links' log ratios.

        Returns:
            ``[3 m, 3 m]``, log scales first, then the gradients in x, then those in y.
        """
        sds = np.concatenate([link_sds, self._own_sds])
        gradients_x = self._n + 2 * members
        columns = np.concatenate([members, gradients_x, gradients_x + 1])
        equations = self._matrix.tocsc()[:, columns]
        weights = diags(1 / sds**2)
        measured = equations.T @ weights @ equations
        m = len(members)
        scale_precision = np.full(m, 1 / _LOOSE_SD**2)
        gradient_precision = np.full(2 * m, 1 / _GRADIENT_SD**2)
        prior = np.concatenate([scale_precision, gradient_precision])
        return np.asarray(measured.toarray() + np.diag(prior))

    def _scaled_residuals(self, sds: Sds) -> Logs:
        """Compute the residuals of all equations, in standard deviations."""
        misfits = self._matrix @ self._unknowns - self._target
        return np.asarray(np.abs(misfits) / sds)

    def _solve(self, weights: Weights, sds: Sds) -> None:
        """Solve the normal equations of weighted least squares."""
        matrix = self._matrix
        precision = weights / sds**2
        measured = matrix.T @ diags(precision) @ matrix
        normal = measured + diags(self._prior)
        right = matrix.T @ (precision * self._target)
        right = right + self._prior_pull
        factorised = splu(normal.tocsc())
        self._unknowns = np.asarray(factorised.solve(right))


def _equations(n: int, links: Sequence[Link], evident: Sequence[int]) -> Any:
    """Make the sparse design matrix of a problem.

    Args:
        n: number of photographs.
        links: between them.
        evident: indices of the photographs with own evidence.

    Returns:
        ``[links + evident, 3 n]``, in the form of compressed rows.
    """
    rows: list[int] = []
    columns: list[int] = []
    values: list[float] = []
    # The equation of a link: x_i + g_i p_ij - x_j - g_j p_ji = r_ij.
    for row, link in enumerate(links):
        first = (1.0, link.first, link.first_at)
        second = (-1.0, link.second, link.second_at)
        for sign, index, (x, y) in (first, second):
            gradient = n + 2 * index
            rows += [row, row, row]
            columns += [index, gradient, gradient + 1]
            values += [sign, sign * x, sign * y]
    # The equation of own evidence: x_i = u_i.
    for row, index in enumerate(evident, start=len(links)):
        rows.append(row)
        columns.append(index)
        values.append(1.0)
    n_equations = len(links) + len(evident)
    entries = (values, (rows, columns))
    return coo_matrix(entries, shape=(n_equations, 3 * n)).tocsr()


def _is_dangling(n: int, links: Sequence[Link]) -> Flags:
    """Find ``[l]`` links to a photograph without another link.

    Such a link always fits, so that its residual does not show its error.
    """
    ends = _ends(links)
    n_links = np.bincount(ends.ravel(), minlength=n)
    has_one_link = n_links[ends] == 1
    return np.asarray(has_one_link.any(axis=1))


def _ends(links: Sequence[Link]) -> Indices:
    """Return the ``[l, 2]`` indices of both photographs of each link."""
    ends = [(link.first, link.second) for link in links]
    return np.array(ends, dtype=np.intp).reshape(-1, 2)


def _components(
    n: int,
    links: Sequence[Link],
    sds: Sds,
    problem: _Problem,
) -> tuple[Subgraph, ...]:
    """Divide the photographs into linked ones, each with scales and their covariance.

    Args:
        n: number of photographs.
        links: those in use.
        sds: ``[l]`` standard deviations of their log ratios.
        problem: solved for these links.
    """
    first, second = _ends(links).T
    # Only whether there is an entry counts for the components, not its value.
    entries = (sds, (first, second))
    adjacency = csr_matrix(entries, shape=(n, n))
    count, labels = connected_components(adjacency, directed=False)
    subgraphs = []
    for label in range(count):
        members = np.flatnonzero(labels == label)
        m = len(members)
        # The inverse of the whole information integrates over the gradients.
        information = problem.information(members, sds)
        whole = np.linalg.inv(information)
        covariance = np.asarray(whole[:m, :m], dtype=np.float64)
        subgraph = Subgraph(members, problem.scales[members], covariance)
        subgraphs.append(subgraph)
    subgraphs.sort(key=_largest_first)
    return tuple(subgraphs)


def _largest_first(subgraph: Subgraph) -> tuple[int, int]:
    """Order subgraphs by size, then by their first photograph."""
    return -len(subgraph.members), int(subgraph.members[0])


def tilt_share(links: Sequence[Link]) -> float:
    """Compute the share of the ratios' squares that one tilt of the camera explains.

    A tilted camera that flies on at one height gives the ratios of a climb. The scale at a point p
    of the image is then ``(1 - q p) ** -1.5`` of the centre's, with the same q in all photographs:
    the tangent of the tilt over the focal length.

    Args:
        links: of one component, between photographs of unknown tilt.

    Returns:
        0..1; 0 for fewer than four photographs, and if no tilt above ten degrees explains at least
        half.
    """
    n = len(np.unique(_ends(links)))
    if n < _MIN_TILT_PHOTOGRAPHS:
        return 0.0
    # Search a grid of q, by size and direction, for the tilt that fits the ratios best.
    sizes = np.geomspace(_MIN_TILT_GRADIENT, _MAX_TILT_GRADIENT, _N_TILT_GRADIENTS)
    turns = np.arange(0.0, 2 * np.pi, _TILT_DIRECTION_STEP)
    gradients, directions = np.meshgrid(sizes, turns)
    across = gradients * np.cos(directions)
    down = gradients * np.sin(directions)
    tilts = np.column_stack([across.ravel(), down.ravel()])
    first_points = np.array([link.first_at for link in links])
    second_points = np.array([link.second_at for link in links])
    first = _log_scales_by_tilt(tilts, first_points)
    second = _log_scales_by_tilt(tilts, second_points)
    ratios = np.array([link.log_ratio for link in links])
    errors = ratios - first + second
    unexplained = (errors**2).sum(axis=1).min()
    # Adjusted for degrees of freedom: two parameters explain a part of any ratios by chance.
    total = max(np.sum(ratios**2), 1e-9)
    unexplained_share = float(unexplained / total)
    share = 1 - unexplained_share * (n - 1) / (n - 3)
    if share >= _MIN_TILT_SHARE:
        return share
    return 0.0


def _log_scales_by_tilt(tilts: Vectors, points: Vectors) -> Logs:
    """Compute log scales at points, over that of the centre, for many tilts.

    Args:
        tilts: ``[t, 2]`` q, see ``tilt_share``.
        points: ``[l, 2]`` from the centre.

    Returns:
        ``[t, l]`` natural logs.
    """
    nearness = np.maximum(1 - tilts @ points.T, _MIN_NEARNESS)
    return np.asarray(-1.5 * np.log(nearness))
