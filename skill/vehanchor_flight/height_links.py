"""Links by the cameras' heights, for photographs whose pictures do not match.

Trees, water and crops can hide that two photographs overlap. Their positions show it, and over
nearly the same ground the ratio of two heights above one take-off is that of the scales.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

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


def link_by_height(
    photographs: Sequence[Photograph],
    overlaps: Sequence[Overlap],
    positions: Positions | None,
) -> list[Overlap]:
    """Link photographs that match no other one, and have no usable scale, to their neighbours.

    Args:
        photographs: of the flight.
        overlaps: by features.
        positions: ``[n, 2]`` metres east and north, NaN for unknown positions; None if all are.

    Returns:
        At most one overlap for each such photograph, without matched points. It places the
        photograph where its neighbour is.
    """
    if positions is None:
        return []
    linked = {index for overlap in overlaps for index in (overlap.first, overlap.second)}
    usable = {
        index
        for index, photograph in enumerate(photographs)
        if photograph.analysis.estimate.status == "ok"
    }
    stations = _stations(photographs, positions)
    supports = [station for station in stations if station.photograph in linked | usable]
    links = []
    for station in stations:
        if station.photograph in linked | usable:
            continue
        neighbour = _neighbour(station, supports, positions)
        if neighbour is not None:
            links.append(_overlap(station, neighbour, photographs))
    return links


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
        step = positions[other.photograph] - positions[station.photograph]
        distance_m = float(np.hypot(*step))
        side_m = min(station.side_m, other.side_m)
        if distance_m <= (1 - _MIN_SHARE) * side_m and distance_m < nearest_m:
            nearest = other
            nearest_m = distance_m
    return nearest


def _overlap(station: _Station, neighbour: _Station, photographs: Sequence[Photograph]) -> Overlap:
    """Make the link of two photographs; their centres lie on each other."""
    first, second = sorted((station, neighbour))
    ratio = first.gsd_m_per_px / second.gsd_m_per_px
    first_centre = _centre(photographs[first.photograph])
    second_centre = _centre(photographs[second.photograph])
    shift = second_centre - ratio * first_centre
    matched = Match(
        math.log(ratio),
        math.hypot(first.log_sd, second.log_sd),
        n=0,
        turn=np.array([[ratio, 0.0, shift[0]], [0.0, ratio, shift[1]]]),
        first_at=first_centre,
        second_at=second_centre,
    )
    return Overlap(first.photograph, second.photograph, matched)


def _centre(photograph: Photograph) -> NDArray[np.float64]:
    image = photograph.view.image
    return np.array([image.width_px, image.height_px]) / 2
