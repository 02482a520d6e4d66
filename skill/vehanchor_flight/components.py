"""Components of a flight: photographs with known ratios of their scales."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.scale.posterior import Witness


@dataclass(frozen=True, eq=False)
class Component:
    """Photographs that are linked to each other.

    Attributes:
        members: ``[n]`` indices of photographs.
        log_scales: ``[n]`` natural logs of their metres per pixel, up to a constant.
        log_sds: ``[n]`` standard deviations of the log ratio of each scale to the reference's.
        reference: index, among the members, of the photograph in whose pixels the evidence is pooled.
        ties: ``[n, n]`` sparse matrix, standard deviation of the log ratio of each link; None for one common scale.
        extra: evidence of rulers that only a flight has, in the reference's pixels.
        maybe_tilted: whether the ratios of its scales may be those of a tilted camera at one height.
    """

    members: NDArray[np.intp]
    log_scales: NDArray[np.float64]
    log_sds: NDArray[np.float64]
    reference: int
    ties: Any = None
    extra: tuple[Witness, ...] = ()
    maybe_tilted: bool = False

    def __len__(self) -> int:
        return len(self.members)

    @property
    def offsets(self) -> NDArray[np.float64]:
        """``[n]`` logs of each member's metres per pixel over the reference's."""
        return np.asarray(self.log_scales - self.log_scales[self.reference])

    def paths(self, sources: Sequence[int]) -> list[tuple[int, tuple[int, ...]] | None]:
        """Find the path of least uncertainty from each member to its nearest source.

        Args:
            sources: indices among the members.

        Returns:
            For each member its source and the members in between, in order; None without a path.
        """
        if self.ties is None:
            return [(place if place in set(sources) else sources[0], ()) for place in range(len(self))]
        from scipy.sparse.csgraph import dijkstra

        _, before, origins = dijkstra(
            self.ties, directed=False, indices=list(sources), min_only=True, return_predecessors=True
        )
        ways: list[tuple[int, tuple[int, ...]] | None] = []
        for place in range(len(self)):
            if origins[place] < 0:
                ways.append(None)
                continue
            between, at = [], int(before[place])
            while at >= 0 and at != origins[place]:
                between.append(at)
                at = int(before[at])
            ways.append((int(origins[place]), tuple(between)))
        return ways


def single_component(members: Sequence[int], reference: int) -> Component:
    """Make one component of photographs that have the same scale.

    Args:
        members: indices of photographs.
        reference: index among the members.
    """
    zeros = np.zeros(len(members))
    return Component(np.asarray(members, dtype=np.intp), zeros, zeros, reference)
