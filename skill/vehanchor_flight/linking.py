"""Linking of photographs: overlaps, ratios of scales, and the components that they form.

Candidate pairs are matched; each match gives a ratio of two scales. The graph of these ratios gives
the scales (``graph``), and the layout checks where the overlaps place the cameras (``layout``).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from vehanchor.rulers.active import uses
from vehanchor.rulers.positions import Positions, baseline, camera_positions_m
from vehanchor.scale.lengths import Z95
from vehanchor_flight.common_ground import Placement, corners_from_above
from vehanchor_flight.components import Component
from vehanchor_flight.copies import shift_of_copy
from vehanchor_flight.graph import Link, Unary, solve, tilt_share
from vehanchor_flight.height_links import link_by_height
from vehanchor_flight.layout import lay_out
from vehanchor_flight.matching import Overlap, can_match, match, shifted
from vehanchor_flight.pairs import candidate_pairs
from vehanchor_flight.photograph import reference_member
from vehanchor_flight.records import FlightLink

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from vehanchor.scale.posterior import Witness
    from vehanchor_flight.features import Features
    from vehanchor_flight.graph import Subgraph
    from vehanchor_flight.layout import Layout
    from vehanchor_flight.photograph import Photograph

    Points: TypeAlias = NDArray[np.float64]
    """Points x, y ``[n, 2]``, in pixels or in metres."""

    Point: TypeAlias = NDArray[np.float64]
    """Point x, y ``[2]`` in pixels."""

    Flags: TypeAlias = NDArray[np.bool_]
    """Which of the photographs ``[n]`` have a property."""

    Offsets: TypeAlias = NDArray[np.float64]
    """Logs ``[n]`` of each photograph's metres per pixel over the reference's."""

# An overlap is dropped if its shift is farther off than this, in diagonals of a photograph.
_MAX_MISPLACED = 0.3
_MAX_SOLUTIONS = 4  # Each further solution leaves out the overlaps that the last one misplaced.
# A photograph's own evidence is never more exact, without errors common to the flight.
_MIN_UNARY_SD = 0.06


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
    positions = _positions(photographs)
    overlaps = _match_candidates(photographs, features, positions)
    overlaps += link_by_height(photographs, overlaps, positions)
    linked = _link_consistently(photographs, overlaps, positions)
    flight_links = [
        _flight_link(
            overlap,
            photographs,
            inflation=linked.inflation,
            dropped=linked.dropped.get(number),
        )
        for number, overlap in enumerate(overlaps)
    ]
    return linked.components, flight_links


class _Linked(NamedTuple):
    """Components with the overlaps that agree.

    Attributes:
        components: the largest first.
        dropped: why an overlap is not used, by its number.
        inflation: spread of the ratios over their own standard deviations, at least 1.
    """

    components: list[Component]
    dropped: dict[int, str]
    inflation: float


def _link_consistently(
    photographs: Sequence[Photograph],
    overlaps: Sequence[Overlap],
    positions: Points | None,
) -> _Linked:
    """Find the components, and leave out the overlaps that contradict the others.

    A copy of the ground elsewhere (the same houses, a repeated pattern) can have a fitting ratio,
    but its shift does not fit the layout. Scales and layout are then solved again without it.

    Args:
        photographs: of the flight.
        overlaps: all that were found.
        positions: ``[n, 2]`` metres; None if unknown.
    """
    unaries = [_unary(photograph) for photograph in photographs]
    # Distance of each misplaced overlap from the layout, by the number of the overlap.
    misplaced: dict[int, float] = {}
    for _ in range(_MAX_SOLUTIONS):
        tried = [number for number in range(len(overlaps)) if number not in misplaced]
        links = [_link(overlaps[number], photographs) for number in tried]
        solution = solve(len(photographs), links, unaries)
        used = {
            number: overlaps[number]
            for number, is_used in zip(tried, solution.used, strict=True)
            if is_used
        }
        components: list[Component] = []
        newly_misplaced: dict[int, float] = {}
        for subgraph in solution.components:
            component, distances = _component(subgraph, photographs, used, positions)
            components.append(component)
            for number, distance in distances.items():
                if distance > _MAX_MISPLACED:
                    newly_misplaced[number] = distance
        if not newly_misplaced:
            break
        misplaced |= newly_misplaced
    dropped = {}
    residuals = solution.residuals.tolist()
    for number, residual in zip(tried, residuals, strict=True):
        if number not in used:
            dropped[number] = _contradicting_text(residual)
    for number, distance in misplaced.items():
        dropped[number] = _misplaced_text(distance)
    return _Linked(components, dropped, solution.inflation)


def _positions(photographs: Sequence[Photograph]) -> Points | None:
    """Read the cameras' positions, ``[n, 2]`` metres; None if unknown, or not to be used."""
    rulers = photographs[0].view.options.rulers
    if not uses(rulers, Positions.kind):
        return None
    images = [photograph.view.image for photograph in photographs]
    return camera_positions_m(images)


def _match_candidates(
    photographs: Sequence[Photograph],
    features: Sequence[Features],
    positions: Points | None,
) -> list[Overlap]:
    """Match the candidate pairs, on the ground plane of tilted photographs."""
    rectified = []
    for photograph, own_features in zip(photographs, features, strict=True):
        rectified.append(_rectified(photograph, own_features))
    pairs = set(candidate_pairs(features, positions))
    copies = _copies(photographs, features)
    overlaps = []
    for first, second in sorted(pairs | copies.keys()):
        matched = match(rectified[first], rectified[second])
        if matched is None and (first, second) in copies:
            matched = shifted(photographs[first].centre_px, copies[first, second])
        if matched is not None:
            overlaps.append(Overlap(first, second, matched))
    return overlaps


def _copies(
    photographs: Sequence[Photograph], features: Sequence[Features]
) -> dict[tuple[int, int], Point]:
    """Find the copies of a picture that has too few features for a match, the lower index first.

    Each copy is paired with the first picture that is the same.

    Returns:
        The shift ``[2]`` of each pair in pixels, from the first to the second.
    """
    originals: list[int] = []
    pairs: dict[tuple[int, int], Point] = {}
    for index, own_features in enumerate(features):
        if can_match(own_features):
            continue
        for original in originals:
            shift = shift_of_copy(photographs[original], photographs[index])
            if shift is not None:
                pairs[original, index] = shift
                break
        else:
            originals.append(index)
    return pairs


def _rectified(photograph: Photograph, features: Features) -> Features:
    """Move the features of a tilted photograph to a nadir view with the scale of its centre."""
    plane = photograph.view.plane
    if plane is None or not len(features):
        return features
    points = plane.from_above(features.points) + photograph.centre_px
    return replace(features, points=points)


def _foot(photograph: Photograph) -> Point:
    """Find the point below the camera, in the pixels of the rectified features.

    The metadata's position is that of this point.
    """
    plane = photograph.view.plane
    if plane is None:
        return photograph.centre_px
    return photograph.centre_px + plane.foot


def _link(overlap: Overlap, photographs: Sequence[Photograph]) -> Link:
    """Make the link of an overlap for the graph of scales."""
    matched = overlap.match
    first = photographs[overlap.first]
    second = photographs[overlap.second]
    return Link(
        overlap.first,
        overlap.second,
        log_ratio=matched.log_ratio,
        log_sd=matched.log_sd,
        first_at=_from_centre(first, matched.first_at),
        second_at=_from_centre(second, matched.second_at),
    )


def _from_centre(photograph: Photograph, point: Point) -> tuple[float, float]:
    """Convert pixels to a position from the centre; 1 is half of the longer side."""
    centre = photograph.centre_px
    position = (point - centre) / centre.max()
    x, y = position.tolist()
    return x, y


def _unary(photograph: Photograph) -> Unary | None:
    """Compute a photograph's own evidence, without errors common to the flight."""
    estimate = photograph.analysis.estimate
    gsd = estimate.gsd_m_per_px
    low = estimate.gsd_ci95_low_m_per_px
    high = estimate.gsd_ci95_high_m_per_px
    if gsd is None or not low or not high:
        return None
    log_sd = math.log(high / low) / (2 * Z95)
    log_sd = max(log_sd, _MIN_UNARY_SD)
    return Unary(math.log(gsd), log_sd)


def _component(
    subgraph: Subgraph,
    photographs: Sequence[Photograph],
    overlaps: Mapping[int, Overlap],
    positions: Points | None,
) -> tuple[Component, dict[int, float]]:
    """Make a component, and compare its overlaps with its layout.

    Args:
        subgraph: linked photographs with their scales.
        photographs: all photographs of the flight.
        overlaps: overlaps in use, by number, of all components.
        positions: ``[n, 2]`` metres; None if unknown.

    Returns:
        The component, and the distance of each overlap's shift from the shift in the layout, by
        number, in diagonals of a photograph.
    """
    members = [photographs[index] for index in subgraph.members]
    reference = reference_member(members)
    # The layout counts the members, and overlaps count all photographs.
    indices = subgraph.members.tolist()
    index_in_component = {index: k for k, index in enumerate(indices)}
    own_overlaps = {
        number: overlap
        for number, overlap in overlaps.items()
        if overlap.first in index_in_component
    }
    member_overlaps = []
    for overlap in own_overlaps.values():
        first = index_in_component[overlap.first]
        second = index_in_component[overlap.second]
        member_overlaps.append(Overlap(first, second, overlap.match))
    offsets = subgraph.log_scales - subgraph.log_scales[reference]
    layout = lay_out(
        np.array([_foot(member) for member in members]),
        np.array([_diagonal(member) for member in members]),
        offsets,
        reference=reference,
        overlaps=member_overlaps,
    )
    extra: tuple[Witness, ...] = ()
    if positions is not None:
        # A link by heights places a photograph where its neighbour is, which is no measurement.
        is_matched = _is_matched(len(members), member_overlaps)
        own_positions = positions[subgraph.members]
        own_positions[~is_matched] = math.nan
        extra = _positions_witness(layout, own_positions, members[reference])
    links = [_link(overlap, photographs) for overlap in own_overlaps.values()]
    tilt_sds = _sds_by_tilt(members, offsets, links)
    link_sds = subgraph.sds_from(reference)
    component = Component(
        subgraph.members,
        subgraph.log_scales,
        log_sds=np.hypot(link_sds, tilt_sds),
        reference=reference,
        placements=_placements(members, layout, offsets),
        extra=extra,
        maybe_tilted=bool(tilt_sds.any()),
    )
    distances = layout.off.tolist()
    return component, dict(zip(own_overlaps, distances, strict=True))


def _is_matched(n: int, overlaps: Sequence[Overlap]) -> Flags:
    """Find which of ``n`` members have an overlap with matched points."""
    is_matched = np.zeros(n, dtype=bool)
    for overlap in overlaps:
        if overlap.match.n > 0:
            is_matched[[overlap.first, overlap.second]] = True
    return is_matched


def _placements(
    members: Sequence[Photograph], layout: Layout, offsets: Offsets
) -> tuple[Placement, ...]:
    """Place the members of a component in the pixels of its reference.

    Args:
        members: of the component.
        layout: of the members.
        offsets: ``[n]`` logs of their metres per pixel over the reference's.
    """
    placements = []
    for k, member in enumerate(members):
        factor = complex(layout.headings[k]) * math.exp(offsets[k])
        foot = complex(*_foot(member))
        placement = Placement(
            0,
            factor,
            shift=complex(layout.feet[k]) - factor * foot,
            corners=corners_from_above(member),
        )
        placements.append(placement)
    return tuple(placements)


def _diagonal(photograph: Photograph) -> float:
    image = photograph.view.image
    return math.hypot(image.width_px, image.height_px)


def _positions_witness(
    layout: Layout, positions: Points, reference: Photograph
) -> tuple[Witness, ...]:
    """Compare the layout in pixels with positions in metres; no witness if they do not match."""
    width_px = float(reference.view.image.width_px)
    witness = baseline(layout.feet, positions, width_px, headings=layout.headings)
    if witness is None:
        return ()
    return (witness,)


def _sds_by_tilt(
    photographs: Sequence[Photograph],
    offsets: Offsets,
    links: Sequence[Link],
) -> Offsets:
    """Compute the errors of offsets that an unknown tilt explains as well as a climb.

    Args:
        photographs: of one component.
        offsets: ``[n]`` logs of their metres per pixel over the reference's.
        links: between them.

    Returns:
        ``[n]`` standard deviations; 0 for a photograph of known tilt.
    """
    is_unknown = np.array([_is_tilt_unknown(photograph) for photograph in photographs])
    if not is_unknown.any():
        return np.zeros(len(photographs))
    # Each photograph has the error of its own offset. The pooled evidence, which was converted by
    # the offsets of all photographs, adds their mean square.
    mean_square = np.mean(offsets**2)
    sds = tilt_share(links) * np.sqrt(offsets**2 + mean_square)
    return np.where(is_unknown, sds, 0.0)


def _is_tilt_unknown(photograph: Photograph) -> bool:
    view = photograph.view
    if view.tilt is not None:
        return False
    if not view.options.rulers.metadata:
        return True
    camera = view.image.camera
    return camera is None or camera.off_nadir_deg is None


def _flight_link(
    overlap: Overlap,
    photographs: Sequence[Photograph],
    inflation: float,
    dropped: str | None,
) -> FlightLink:
    """Make the record of an overlap."""
    return FlightLink(
        first=photographs[overlap.first].name,
        second=photographs[overlap.second].name,
        ratio=math.exp(overlap.match.log_ratio),
        ratio_log_sd=overlap.match.log_sd * inflation,
        n_matches=overlap.match.n,
        dropped=dropped,
    )


def _misplaced_text(distance: float) -> str:
    return f"its shift differs by {distance:.1f} photographs from that of the other overlaps"


def _contradicting_text(residual: float) -> str:
    factor = math.exp(abs(residual))
    return (
        f"its ratio differs by a factor of {factor:.2g} from that of the other overlaps and rulers"
    )
