"""Linking of photographs: overlaps, ratios of scales, and the components that they form."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.flight.components import Component
from vehanchor.flight.graph import Link, Unary, contradiction, solve
from vehanchor.flight.layout import Seam, lay_out
from vehanchor.flight.matching import match
from vehanchor.flight.pairs import candidate_pairs
from vehanchor.flight.photograph import chief_member
from vehanchor.records import FlightLink
from vehanchor.rulers.positions import Positions, baseline, places_of, positions_evidence
from vehanchor.rulers.registry import uses
from vehanchor.scale.lengths import Z95

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.flight.components import Component
    from vehanchor.flight.features import Features
    from vehanchor.flight.graph import Solution, Subgraph
    from vehanchor.flight.matching import Match
    from vehanchor.flight.photograph import Photograph

_LEAST_UNARY_SD = 0.06  # of a photograph's own evidence, without errors common to the flight


class LinkedFlight(NamedTuple):
    """Components and overlaps of a flight.

    Attributes:
        components: with indices of photographs, the largest first.
        links: all overlaps.
    """

    components: tuple[Component, ...]
    links: tuple[FlightLink, ...]


def link_photographs(
    photographs: Sequence[Photograph],
    features: Sequence[Features],
) -> LinkedFlight:
    """Link photographs by their overlaps.

    Args:
        photographs: in the order in which they were taken.
        features: of each photograph.

    Returns:
        Components and overlaps.
    """
    rulers = photographs[0].view.options.rulers
    places = places_of([each.view.image for each in photographs]) if uses(rulers, Positions.kind) else None
    pairs = candidate_pairs(features, places)
    found: list[tuple[int, int, Match]] = []
    for first, second in pairs:
        matched = match(features[first], features[second])
        if matched is not None:
            found.append((first, second, matched))
    links = [
        Link(
            first,
            second,
            matched.log_ratio,
            matched.log_sd,
            _from_centre(photographs[first], matched.first_at),
            _from_centre(photographs[second], matched.second_at),
        )
        for first, second, matched in found
    ]
    solution = solve(len(photographs), links, [_unary(each) for each in photographs])
    made = [_component(subgraph, photographs, found, solution, places) for subgraph in solution.components]
    return LinkedFlight(
        tuple(made),
        tuple(
            FlightLink(
                first=photographs[first].name,
                second=photographs[second].name,
                ratio=math.exp(matched.log_ratio),
                ratio_log_sd=matched.log_sd * solution.inflation,
                n_matches=matched.n,
                dropped=None if used else contradiction(float(residual)),
            )
            for (first, second, matched), used, residual in zip(found, solution.used, solution.residuals, strict=True)
        ),
    )


def _from_centre(photograph: Photograph, at: NDArray[np.float64]) -> tuple[float, float]:
    width, height = photograph.view.image.width_px, photograph.view.image.height_px
    reach = max(width, height) / 2
    return (float(at[0]) - width / 2) / reach, (float(at[1]) - height / 2) / reach


def _unary(photograph: Photograph) -> Unary | None:
    """Compute a photograph's own evidence, without errors common to the flight."""
    estimate = photograph.analysis.estimate
    low, high = estimate.gsd_ci95_low_m_per_px, estimate.gsd_ci95_high_m_per_px
    if estimate.gsd_m_per_px is None or not low or not high:
        return None
    return Unary(math.log(estimate.gsd_m_per_px), max(math.log(high / low) / (2 * Z95), _LEAST_UNARY_SD))


def _component(
    subgraph: Subgraph,
    photographs: Sequence[Photograph],
    found: Sequence[tuple[int, int, Match]],
    solution: Solution,
    places: NDArray[np.float64] | None,
) -> Component:
    members = subgraph.members
    own = [photographs[place] for place in members]
    reference = chief_member(own)
    inside = set(members.tolist())
    at = {int(place): local for local, place in enumerate(members)}
    seams = [
        Seam(at[first], at[second], matched.turn, float(matched.n))
        for (first, second, matched), used in zip(found, solution.used, strict=True)
        if used and first in inside
    ]
    centres = np.array([(each.view.image.width_px / 2, each.view.image.height_px / 2) for each in own])
    offsets = subgraph.log_scales - subgraph.log_scales[reference]
    layout = lay_out(centres, offsets, reference, seams)
    extra = None
    if places is not None:
        extra = baseline(layout, places[members], float(own[reference].view.image.width_px))
    return Component(
        members,
        subgraph.log_scales,
        subgraph.sds_from(reference),
        reference,
        subgraph.ties,
        positions_evidence(extra),
        layout,
    )
