"""Islands of a flight: photographs whose ratios of scales are known, and who hangs on whom."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.rulers.evidence import Evidence


@dataclass(frozen=True, eq=False)
class Component:
    """Photographs that are tied to each other.

    Attributes:
        members: ``[n]`` indices of photographs.
        log_scales: ``[n]`` natural logs of their metres per pixel, but for a constant.
        log_sds: ``[n]`` standard deviations of these, seen from the reference.
        reference: index, among the members, of the one in whose pixels evidence is put together.
        ties: ``[n, n]`` sparse matrix, uncertainty of the ratio of two that overlap; None where all are of one scale.
        extra: evidence of rulers that only a flight has, in the reference's pixels.
        layout: ``[n]`` centres in pixels of the reference, y down; None where nobody laid them out.
    """

    members: NDArray[np.intp]
    log_scales: NDArray[np.float64]
    log_sds: NDArray[np.float64]
    reference: int
    ties: Any = None
    extra: tuple[Evidence, ...] = ()
    layout: NDArray[np.complex128] | None = None

    def __len__(self) -> int:
        return len(self.members)

    @property
    def offsets(self) -> NDArray[np.float64]:
        """``[n]`` logs of how much larger a pixel of each is than one of the reference."""
        return np.asarray(self.log_scales - self.log_scales[self.reference])

    def paths(self, sources: Sequence[int]) -> list[tuple[int, tuple[int, ...]] | None]:
        """The least uncertain way from each member to the nearest of some sources.

        Args:
            sources: indices among the members.

        Returns:
            For each member the source and the members in between, from it to the source; None without a way.
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
    """Photographs of one scale.

    Args:
        members: indices of photographs.
        reference: index among the members.
    """
    zeros = np.zeros(len(members))
    return Component(np.asarray(members, dtype=np.intp), zeros, zeros, reference)
