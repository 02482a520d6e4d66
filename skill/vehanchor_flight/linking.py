"""Linking of photographs: overlaps, ratios of scales, and the components that they form."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.rulers.active import uses
from vehanchor.rulers.positions import Positions, baseline, places_of
from vehanchor.scale.lengths import Z95
from vehanchor_flight.components import Component
from vehanchor_flight.graph import Link, Unary, solve, tilt_share
from vehanchor_flight.layout import lay_out
from vehanchor_flight.matching import Overlap, match
from vehanchor_flight.pairs import candidate_pairs
from vehanchor_flight.photograph import chief_member
from vehanchor_flight.records import FlightLink

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor_flight.components import Component
    from vehanchor_flight.features import Features
    from vehanchor_flight.graph import Subgraph
    from vehanchor_flight.photograph import Photograph

# of a photograph's diagonal: an overlap whose shift is further off is dropped
_MOST_MISPLACED = 0.3
_MOST_SOLUTIONS = 4
_LEAST_UNARY_SD = 0.06  # of a photograph's own evidence, without errors common to the flight


def link_photographs(
    photographs: Sequence[Photograph],
    features: Sequence[Features],
) -> tuple[list[Component], list[FlightLink]]:
    """Link photographs by their overlaps.

    Args:
        photographs: in the order in which they were taken.
        features: of each photograph.

    Returns:
        Components with indices of photographs, the largest first, and all overlaps.
    """
    rulers = photographs[0].view.options.rulers
    places = (
        places_of([each.view.image for each in photographs])
        if uses(rulers, Positions.kind)
        else None
    )
    found = _matches(photographs, features, places)
    unaries = [_unary(each) for each in photographs]
    misplaced: dict[int, float] = {}
    for _ in range(_MOST_SOLUTIONS):
        kept = [number for number in range(len(found)) if number not in misplaced]
        solution = solve(
            len(photographs), [_link(found[number], photographs) for number in kept], unaries
        )
        used = [number for number, agrees in zip(kept, solution.used, strict=True) if agrees]
        components: list[Component] = []
        wrong: dict[int, float] = {}
        for subgraph in solution.components:
            inside = set(subgraph.members.tolist())
            numbers = [number for number in used if found[number].first in inside]
            component, off = _component(
                subgraph, photographs, found=[found[number] for number in numbers], places=places
            )
            components.append(component)
            wrong |= {
                number: far
                for number, far in zip(numbers, off.tolist(), strict=True)
                if far > _MOST_MISPLACED
            }
        if not wrong:
            break
        misplaced |= wrong
    off_ratio = dict(zip(kept, solution.residuals.tolist(), strict=True))
    links = []
    for number, (first, second, matched) in enumerate(found):
        dropped = None
        if number in misplaced:
            dropped = (
                f"its shift is {misplaced[number]:.1f} photographs off the shift by the "
                "other overlaps"
            )
        elif number not in used:
            times = math.exp(abs(off_ratio[number]))
            dropped = (
                f"the ratio is {times:.2g} times off the ratio by the other overlaps and rulers"
            )
        links.append(
            FlightLink(
                first=photographs[first].name,
                second=photographs[second].name,
                ratio=math.exp(matched.log_ratio),
                ratio_log_sd=matched.log_sd * solution.inflation,
                n_matches=matched.n,
                dropped=dropped,
            )
        )
    return components, links


def _matches(
    photographs: Sequence[Photograph],
    features: Sequence[Features],
    places: NDArray[np.float64] | None,
) -> list[Overlap]:
    """Match the candidate pairs, on the ground plane of tilted photographs."""
    pairs = candidate_pairs(features, places)
    above = [
        _rectified(photograph, own) for photograph, own in zip(photographs, features, strict=True)
    ]
    return [
        Overlap(first, second, found)
        for first, second in pairs
        if (found := match(above[first], above[second]))
    ]


def _rectified(photograph: Photograph, features: Features) -> Features:
    """Move the features of a tilted photograph to a nadir view with the scale of its centre."""
    view = photograph.view
    if view.tilt is None or not len(features):
        return features
    return replace(
        features,
        points=view.tilt.plane(view.image).from_above(features.points) + _centre(photograph),
    )


def _centre(photograph: Photograph) -> NDArray[np.float64]:
    return np.array([photograph.view.image.width_px, photograph.view.image.height_px]) / 2


def _foot(photograph: Photograph) -> NDArray[np.float64]:
    """Find the point below the camera, where its position lies, in the pixels of the rectified features."""
    view = photograph.view
    return _centre(photograph) + (0.0 if view.tilt is None else view.tilt.plane(view.image).foot)


def _link(overlap: Overlap, photographs: Sequence[Photograph]) -> Link:
    first, second, matched = overlap
    return Link(
        first,
        second,
        log_ratio=matched.log_ratio,
        log_sd=matched.log_sd,
        first_at=_from_centre(photographs[first], matched.first_at),
        second_at=_from_centre(photographs[second], matched.second_at),
    )


def _from_centre(photograph: Photograph, at: NDArray[np.float64]) -> tuple[float, float]:
    centre = _centre(photograph)
    x, y = ((at - centre) / centre.max()).tolist()
    return x, y


def _unary(photograph: Photograph) -> Unary | None:
    """Compute a photograph's own evidence, without errors common to the flight."""
    estimate = photograph.analysis.estimate
    low = estimate.gsd_ci95_low_m_per_px
    high = estimate.gsd_ci95_high_m_per_px
    if estimate.gsd_m_per_px is None or not low or not high:
        return None
    return Unary(
        math.log(estimate.gsd_m_per_px), max(math.log(high / low) / (2 * Z95), _LEAST_UNARY_SD)
    )


def _sds_by_tilt(
    photographs: Sequence[Photograph], offsets: NDArray[np.float64], links: Sequence[Link]
) -> NDArray[np.float64]:
    """Compute ``[n]`` standard deviations of offsets that an unknown tilt of the camera explains as well as a climb.

    The evidence of all photographs was carried by these offsets, so that their mean square adds to
    each.
    """
    unknown = np.array([_tilt_unknown(each) for each in photographs])
    share = tilt_share(links) if unknown.any() else 0.0
    return np.asarray(share * unknown * np.sqrt(offsets**2 + np.mean(offsets**2)))


def _tilt_unknown(photograph: Photograph) -> bool:
    view = photograph.view
    camera = view.image.camera if view.options.rulers.metadata else None
    return view.tilt is None and (camera is None or camera.off_nadir_deg is None)


def _component(
    subgraph: Subgraph,
    photographs: Sequence[Photograph],
    found: Sequence[Overlap],
    places: NDArray[np.float64] | None,
) -> tuple[Component, NDArray[np.float64]]:
    """Make a component, and the distance of each overlap's shift to its layout."""
    members = subgraph.members
    own = [photographs[place] for place in members]
    reference = chief_member(own)
    at = {int(place): local for local, place in enumerate(members)}
    inside = [Overlap(at[first], at[second], matched) for first, second, matched in found]
    feet = np.array([_foot(each) for each in own])
    diagonals = np.array(
        [math.hypot(each.view.image.width_px, each.view.image.height_px) for each in own]
    )
    offsets = subgraph.log_scales - subgraph.log_scales[reference]
    layout, off = lay_out(feet, diagonals, offsets, reference, inside)
    extra = None
    if places is not None:
        extra = baseline(layout, places[members], float(own[reference].view.image.width_px))
    by_tilt = _sds_by_tilt(own, offsets, [_link(each, photographs) for each in found])
    component = Component(
        members,
        subgraph.log_scales,
        log_sds=np.hypot(subgraph.sds_from(reference), by_tilt),
        reference=reference,
        extra=() if extra is None else (extra,),
        maybe_tilted=bool(by_tilt.any()),
    )
    return component, off
