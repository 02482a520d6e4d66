"""Graph of a flight: log scales of photographs from ratios of overlapping ones and from each one's own evidence.

    minimise  sum over links rho((x_i + g_i p_ij - x_j - g_j p_ji - r_ij) / s_ij)  +  sum rho((x_i -
    u_i) / t_i)
              +  sum (g_i / t)^2

x_i is the log scale at the centre of a photograph and g_i its gradient. The gradient is needed
because a tilt of a few degrees changes the scale from edge to edge, and photographs overlap at
their edges (at p_ij). rho is the Geman-McClure loss, which ignores outliers. Graduated
non-convexity goes from the square loss to rho; each step is a sparse least-squares problem, so that
the result does not depend on a start. The flight's own residuals give the real spread of the
ratios, with relief and tilt.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

_REACH = 3.0  # standard deviations, scale of the robust loss
# a link that is off by more than both is dropped
_DROP_SDS = 4.0
_DROP_LOG = 0.12
_ANNEAL = 1.4
_STEPS = 40
_MOST_INFLATION = 8.0
_GRADIENT_SD = 0.05  # log of scale from the centre to the edge: a tilt of two to five degrees
_LOOSE_SD = 3.0  # of a photograph without evidence: keeps the problem regular
_MAD_PER_SD = 0.6745
_LEAST_TILT_PHOTOGRAPHS = 4
_LEAST_TILT_SHARE = 0.5
# half of the longer side over the focal length, times the tangent of 10 to 52 degrees
_TILT_GRADIENTS = 0.12, 0.9
# of a point to the camera's foot, over the centre's: keeps away from the horizon
_LEAST_NEARNESS = 0.15


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

    members: NDArray[np.intp]
    log_scales: NDArray[np.float64]
    covariance: NDArray[np.float64]

    def sds_from(self, reference: int) -> NDArray[np.float64]:
        """Compute ``[m]`` standard deviations of the members' log scales relative to the reference."""
        own = np.diag(self.covariance)
        variance = own + own[reference] - 2 * self.covariance[reference]
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


class Solution(NamedTuple):
    """Scales of a flight.

    Attributes:
        components: the largest first, then by the first index.
        residuals: ``[l]`` measured less fitted log ratio of each link.
        used: ``[l]`` bool, links in use.
        inflation: spread of the ratios over their own standard deviations, at least 1.
    """

    components: tuple[Subgraph, ...]
    residuals: NDArray[np.float64]
    used: NDArray[np.bool_]
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
    declared_sds = np.array([link.log_sd for link in links], dtype=np.float64)
    problem = _Problem(n, links, unaries)
    alone = _at_an_end(n, links)
    inflation = 1.0
    for _ in range(2):
        problem.anneal(declared_sds * inflation)
        looped = np.abs(problem.residuals[~alone]) / declared_sds[~alone]
        if len(looped):
            inflation = float(np.clip(np.median(looped) / _MAD_PER_SD, 1.0, _MOST_INFLATION))
    sds = declared_sds * inflation
    used = ~(
        (np.abs(problem.residuals) > _DROP_SDS * sds) & (np.abs(problem.residuals) > _DROP_LOG)
    )
    residuals = problem.residuals
    kept = [link for link, chosen in zip(links, used, strict=True) if chosen]
    if not used.all():
        problem = _Problem(n, kept, unaries)
        problem.anneal(sds[used])
        residuals = np.where(used, 0.0, residuals)
        residuals[used] = problem.residuals
    components = _components(n, kept, sds[used], problem)
    return Solution(components, residuals, used=used, inflation=inflation)


class _Problem:
    """Robust sparse least-squares problem; unknowns are ``[n]`` log scales, then ``[n, 2]`` gradients."""

    def __init__(self, n: int, links: Sequence[Link], unaries: Sequence[Unary | None]) -> None:
        self._n = n
        self._n_links = len(links)
        known = [(place, unary) for place, unary in enumerate(unaries) if unary is not None]
        self._matrix = _equations(n, links, [place for place, _ in known])
        said = [unary.log_scale for _, unary in known]
        self._target = np.concatenate([[link.log_ratio for link in links], said])
        self._own_sds = np.array([unary.log_sd for _, unary in known], dtype=np.float64)
        middle = float(np.median(said)) if said else 0.0
        self._prior = np.r_[np.full(n, 1e-3 / _LOOSE_SD**2), np.full(2 * n, 1 / _GRADIENT_SD**2)]
        self._prior_pull = np.r_[np.full(n, middle * 1e-3 / _LOOSE_SD**2), np.zeros(2 * n)]
        self._found = np.zeros(3 * n)

    @property
    def scales(self) -> NDArray[np.float64]:
        """``[n]`` log scales."""
        return np.asarray(self._found[: self._n])

    @property
    def residuals(self) -> NDArray[np.float64]:
        """``[l]`` measured less fitted log ratio of each link."""
        return np.asarray((self._target - self._matrix @ self._found)[: self._n_links])

    def anneal(self, link_sds: NDArray[np.float64]) -> None:
        """Solve, in steps from the square loss to the robust loss."""
        sds = np.concatenate([link_sds, self._own_sds])
        self._solve(np.ones(len(sds)), sds)
        if not len(sds):
            return
        mu = max(1.0, 2 * float(np.max(self._off(sds) ** 2)) / _REACH**2)
        for _ in range(_STEPS):
            self._solve((mu * _REACH**2 / (self._off(sds) ** 2 + mu * _REACH**2)) ** 2, sds)
            if mu == 1.0:
                break
            mu = max(1.0, mu / _ANNEAL)

    def information(
        self, members: NDArray[np.intp], link_sds: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Compute ``[3 m, 3 m]``, the inverse covariance of the members' unknowns."""
        sds = np.concatenate([link_sds, self._own_sds])
        which = np.r_[members, self._n + 2 * members, self._n + 2 * members + 1]
        own = self._matrix.tocsc()[:, which]
        whole = (own.T @ diags(1 / sds**2) @ own).toarray()
        m = len(members)
        return np.asarray(
            whole
            + np.diag(np.r_[np.full(m, 1 / _LOOSE_SD**2), np.full(2 * m, 1 / _GRADIENT_SD**2)])
        )

    def _off(self, sds: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(np.abs(self._matrix @ self._found - self._target) / sds)

    def _solve(self, weights: NDArray[np.float64], sds: NDArray[np.float64]) -> None:
        precision = weights / sds**2
        normal = self._matrix.T @ diags(precision) @ self._matrix + diags(self._prior)
        right = self._matrix.T @ (precision * self._target) + self._prior_pull
        self._found = np.asarray(splu(normal.tocsc()).solve(right))


def _equations(n: int, links: Sequence[Link], known: Sequence[int]) -> Any:
    """Make the sparse design matrix ``[links + known, 3 n]`` of links and own evidence."""
    rows = []
    columns = []
    values = []
    for row, link in enumerate(links):
        for sign, place, at in (
            (1.0, link.first, link.first_at),
            (-1.0, link.second, link.second_at),
        ):
            rows += [row] * 3
            columns += [place, n + 2 * place, n + 2 * place + 1]
            values += [sign, sign * at[0], sign * at[1]]
    rows += [len(links) + each for each in range(len(known))]
    columns += known
    values += [1.0] * len(known)
    return coo_matrix((values, (rows, columns)), shape=(len(links) + len(known), 3 * n)).tocsr()


def _at_an_end(n: int, links: Sequence[Link]) -> NDArray[np.bool_]:
    """Find ``[l]`` links to a photograph without another link: they always fit, so they tell nothing of errors."""
    ends = np.array([(link.first, link.second) for link in links], dtype=np.intp).reshape(-1, 2)
    degree = np.bincount(ends.ravel(), minlength=n)
    return np.asarray((degree[ends[:, 0]] == 1) | (degree[ends[:, 1]] == 1))


def _components(
    n: int, links: Sequence[Link], sds: NDArray[np.float64], problem: _Problem
) -> tuple[Subgraph, ...]:
    ends = np.array([(link.first, link.second) for link in links], dtype=np.intp).reshape(-1, 2)
    ties = csr_matrix((sds, (ends[:, 0], ends[:, 1])), shape=(n, n))
    count, labels = connected_components(ties, directed=False)
    found = []
    for label in range(count):
        members = np.flatnonzero(labels == label)
        m = len(members)
        covariance = np.asarray(
            np.linalg.inv(problem.information(members, sds))[:m, :m], dtype=np.float64
        )
        found.append(Subgraph(members, problem.scales[members], covariance))
    return tuple(sorted(found, key=lambda each: (-len(each.members), int(each.members[0]))))


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
    n = len({end for link in links for end in (link.first, link.second)})
    if n < _LEAST_TILT_PHOTOGRAPHS:
        return 0.0
    ratios = np.array([link.log_ratio for link in links])
    ends = [
        np.array([link.first_at for link in links]),
        np.array([link.second_at for link in links]),
    ]
    sizes, turns = np.meshgrid(
        np.geomspace(*_TILT_GRADIENTS, 16), np.arange(0.0, 2 * np.pi, np.pi / 18)
    )
    tilts = np.column_stack([(sizes * np.cos(turns)).ravel(), (sizes * np.sin(turns)).ravel()])
    first, second = (-1.5 * np.log(np.maximum(1 - tilts @ at.T, _LEAST_NEARNESS)) for at in ends)
    left = ((ratios - first + second) ** 2).sum(axis=1).min()
    # less what two parameters fit by chance
    share = 1 - float(left / max(np.sum(ratios**2), 1e-9)) * (n - 1) / (n - 3)
    return share if share >= _LEAST_TILT_SHARE else 0.0
