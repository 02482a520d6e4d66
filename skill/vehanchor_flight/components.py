"""Components of a flight: photographs with known ratios of their scales."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.scale.posterior import Witness
    from vehanchor_flight.common_ground import Placement

    Logs: TypeAlias = NDArray[np.float64]
    """Natural logs ``[m]`` of the members' metres per pixel, or their standard deviations."""


@dataclass(frozen=True, eq=False)
class Component:
    """Photographs that are linked to each other.

    Attributes:
        members: ``[n]`` indices of photographs.
        log_scales: ``[n]`` natural logs of their metres per pixel, up to a constant.
        log_sds: ``[n]`` standard deviations of the log ratio of each scale to the reference's.
        reference: index, among the members, of the photograph in whose pixels the evidence is
            pooled.
        placements: of the members on their ground; empty if nothing is known of common ground.
        extra: evidence of rulers that only a flight has, in the reference's pixels.
        maybe_tilted: whether the ratios of its scales may be those of a tilted camera at one
            height.
    """

    members: NDArray[np.intp]
    log_scales: Logs
    log_sds: Logs
    reference: int
    placements: tuple[Placement, ...] = ()
    extra: tuple[Witness, ...] = ()
    maybe_tilted: bool = False

    def __len__(self) -> int:
        return len(self.members)

    @property
    def offsets(self) -> Logs:
        """``[n]`` logs of each member's metres per pixel over the reference's."""
        reference = self.log_scales[self.reference]
        return np.asarray(self.log_scales - reference)


def single_component(
    members: Sequence[int], reference: int, placements: Sequence[Placement] = ()
) -> Component:
    """Make one component of photographs that have the same scale.

    Args:
        members: indices of photographs.
        reference: index among the members.
        placements: as in ``Component``.
    """
    zeros = np.zeros(len(members))
    indices = np.asarray(members, dtype=np.intp)
    return Component(
        indices,
        zeros,
        log_sds=zeros,
        reference=reference,
        placements=tuple(placements),
    )


def placements_by_ground(components: Sequence[Component]) -> tuple[Placement, ...]:
    """List the placements of all photographs; each component is a ground of its own.

    Args:
        components: each photograph is a member of one.

    Returns:
        ``[n]`` placements in the order of the photographs.
    """
    placements: dict[int, Placement] = {}
    for ground, component in enumerate(components):
        indices = component.members.tolist()
        for index, placement in zip(indices, component.placements, strict=True):
            placements[index] = replace(placement, ground=ground)
    return tuple(placements[index] for index in sorted(placements))
