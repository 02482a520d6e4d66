"""Links by the cameras' heights, for photographs whose pictures do not match.

Trees, water and crops can hide that two photographs overlap. Their positions show it, and over
nearly the same ground the ratio of two heights above one take-off is that of the scales.
"""

from __future__ import annotations

import math
from collections import Counter
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components

from vehanchor.scale.reliability import RELIABILITY
from vehanchor_flight.matching import Match, Overlap
from vehanchor_flight.record import number_sorties
from vehanchor_flight.same_scale import by_height_and_lens

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor_flight.photograph import Photograph

    Positions: TypeAlias = NDArray[np.float64]
    """Positions ``[n, 2]`` in metres."""

# Error of a height relative to another one of the same sortie. The take-off is common to both, and
# so is the lens. A choice.
_HEIGHT_SD_M = 1.0
# Least part of a photograph that its neighbour shows, too, by the positions. A choice.
_MIN_SHARE = 0.5


class _Station(NamedTuple):
    """Photograph of known place and camera.

    Attributes:
        photograph: its index.
        sortie: number of its sortie, which has one take-off.
        log_sd: standard deviation of the log scale, relative to others of the sortie.
        gsd_m_per_px: scale by height and lens.
        side_m: side of a square as large as the ground that it shows, metres.
    """

    photograph: int
    sortie: int
    log_sd: float
    gsd_m_per_px: float
    side_m: float


_Step: TypeAlias = tuple[_Station, _Station]
"""A station and the neighbour that it is linked to."""


def link_by_height(
    photographs: Sequence[Photograph],
    overlaps: Sequence[Overlap],
    positions: Positions | None,
) -> list[Overlap]:
    """Link photographs without a usable scale to neighbours that their pictures do not match.

    Photographs that match each other are a group. A group without a usable scale is linked to a
    neighbour in a group that has one, or that has been linked to one; a photograph that matches no
    other one, to any neighbour in a group.

    Args:
        photographs: of the flight.
        overlaps: by features.
        positions: ``[n, 2]`` metres east and north, NaN for unknown positions; None if all are.

    Returns:
        At most one overlap for each group, without matched points. It places one photograph where
        its neighbour is.
    """
    if positions is None:
        return []
    groups = _groups(len(photographs), overlaps)
    stations = _stations(photographs, positions)
    supporting = {
        group
        for group, photograph in zip(groups, photographs, strict=True)
        if photograph.analysis.estimate.status == "ok"
    }
    steps = _chain(supporting, groups, stations, positions)
    sizes = Counter(groups)
    supporting |= {group for group, size in sizes.items() if size > 1}
    steps += _chain(supporting, groups, stations, positions)
    return [_overlap(station, neighbour, photographs) for station, neighbour in steps]


def _groups(n_photographs: int, overlaps: Sequence[Overlap]) -> list[int]:
    """Number the groups of photographs that overlaps connect."""
    first = [overlap.first for overlap in overlaps]
    second = [overlap.second for overlap in overlaps]
    entries = (np.ones(len(overlaps)), (first, second))
    adjacency = csr_matrix(entries, shape=(n_photographs, n_photographs))
    _, groups = connected_components(adjacency, directed=False)
    numbers: list[int] = groups.tolist()
    return numbers


def _chain(
    supporting: set[int],
    groups: Sequence[int],
    stations: Sequence[_Station],
    positions: Positions,
) -> list[_Step]:
    """Step from the supporting groups to neighbours, and from these to theirs.

    Args:
        supporting: numbers of groups; those that are reached join them.
        groups: number of the group of each photograph.
        stations: photographs of known place and camera.
        positions: as in ``link_by_height``.

    Returns:
        One step for each group that is reached.
    """
    chain: list[_Step] = []
    while steps := _steps_to(supporting, groups, stations, positions):
        supporting.update(steps)
        chain += steps.values()
    return chain


def _steps_to(
    supporting: set[int],
    groups: Sequence[int],
    stations: Sequence[_Station],
    positions: Positions,
) -> dict[int, _Step]:
    """Find the shortest step from each other group to a neighbour in one of the supporting ones.

    Returns:
        The station and its neighbour, by the number of the other group.
    """
    supports = [station for station in stations if groups[station.photograph] in supporting]
    steps: dict[int, _Step] = {}
    distances_m: dict[int, float] = {}
    for station in stations:
        group = groups[station.photograph]
        if group in supporting:
            continue
        neighbour = _neighbour(station, supports, positions)
        if neighbour is None:
            continue
        distance_m = _distance_m(station, neighbour, positions)
        if distance_m < distances_m.get(group, math.inf):
            distances_m[group] = distance_m
            steps[group] = (station, neighbour)
    return steps


def _stations(photographs: Sequence[Photograph], positions: Positions) -> list[_Station]:
    """List the photographs with a position, a height and a lens."""
    sorties = number_sorties([photograph.view.image for photograph in photographs])
    stations = []
    for index, photograph in enumerate(photographs):
        image = photograph.view.image
        camera = image.camera
        claim = by_height_and_lens(photograph)
        is_placed = bool(np.isfinite(positions[index]).all())
        if claim is None or camera is None or not is_placed:
            continue
        if camera.height_m is None:
            continue
        tilt_log_sd = 0.0
        if camera.off_nadir_deg is None:
            tilt_log_sd = RELIABILITY["camera, tilt unknown"].log_sd
        station = _Station(
            index,
            sorties[index],
            log_sd=math.hypot(_HEIGHT_SD_M / camera.height_m, tilt_log_sd),
            gsd_m_per_px=claim.scale,
            side_m=math.sqrt(image.width_px * image.height_px) * claim.scale,
        )
        stations.append(station)
    return stations


def _neighbour(
    station: _Station, others: Sequence[_Station], positions: Positions
) -> _Station | None:
    """Find the nearest photograph of the same sortie that shows nearly the same ground."""
    nearest = None
    nearest_m = math.inf
    for other in others:
        if other.sortie != station.sortie:
            continue
        distance_m = _distance_m(station, other, positions)
        side_m = min(station.side_m, other.side_m)
        if distance_m <= (1 - _MIN_SHARE) * side_m and distance_m < nearest_m:
            nearest = other
            nearest_m = distance_m
    return nearest


def _distance_m(station: _Station, other: _Station, positions: Positions) -> float:
    """Compute the distance of two stations."""
    step = positions[other.photograph] - positions[station.photograph]
    return float(np.hypot(*step))


def _overlap(station: _Station, neighbour: _Station, photographs: Sequence[Photograph]) -> Overlap:
    """Make the link of two photographs; their centres lie on each other."""
    first, second = sorted((station, neighbour))
    ratio = first.gsd_m_per_px / second.gsd_m_per_px
    first_centre = photographs[first.photograph].centre_px
    second_centre = photographs[second.photograph].centre_px
    shift = second_centre - ratio * first_centre
    turn = np.column_stack([ratio * np.eye(2), shift])
    matched = Match(
        math.log(ratio),
        math.hypot(first.log_sd, second.log_sd),
        n=0,
        turn=turn,
        first_at=first_centre,
        second_at=second_centre,
    )
    return Overlap(first.photograph, second.photograph, matched)
