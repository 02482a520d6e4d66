"""Positions as a ruler: distances between photographs of a flight, in metres over pixels."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.rulers.ruler import Ruler, point_witness
from vehanchor.scale.density import on_grid
from vehanchor.scale.reliability import RELIABILITY

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.imagery.facts import ImageFacts
    from vehanchor.rulers.ruler import View
    from vehanchor.scale.posterior import Witness

_EARTH_M = 6_371_009.0
_LEAST = 2
_POSITION_SD_M = 2.0  # of a small receiver, relative to the neighbouring photograph
_AIM_SHARE = 0.05  # of the picture's width: offset of the centre by a tilt of three degrees
_LEAST_AGREEMENT = 0.9  # of layout and positions; below, they do not match
_REACH = 3.0
_STEPS = 10


class Positions(Ruler):
    """Positions in the metadata of a flight's photographs; the flight measures them (``baseline``)."""

    kind = "positions"
    label = "positions"
    plural = True
    help = "photographs of a flight with positions in their metadata"
    colour = "#56B4E9"
    reads_metadata = True
    uses_plane = True

    def measure(self, view: View) -> Witness | None:  # noqa: ARG002
        """Measure nothing: a single image has no baseline."""
        return None


def places_of(images: Sequence[ImageFacts]) -> NDArray[np.float64] | None:
    """Read the positions of photographs.

    Args:
        images: their facts.

    Returns:
        ``[n, 2]`` metres east and north of the first known position, NaN for unknown ones; None if
        all are unknown.
    """
    known = [
        (math.nan, math.nan)
        if (camera := image.camera) is None
        or camera.latitude_deg is None
        or camera.longitude_deg is None
        else (camera.latitude_deg, camera.longitude_deg)
        for image in images
    ]
    degrees = np.array(known, dtype=np.float64).reshape(-1, 2)
    said = np.flatnonzero(np.isfinite(degrees[:, 0]))
    if not len(said):
        return None
    north, east = np.radians(degrees - degrees[said[0]]).T
    east = np.where(
        east > math.pi, east - 2 * math.pi, np.where(east < -math.pi, east + 2 * math.pi, east)
    )
    return np.column_stack([east * math.cos(math.radians(degrees[said[0], 0])), north]) * _EARTH_M


def baseline(
    layout: NDArray[np.complex128], places: NDArray[np.float64], width_px: float
) -> Witness | None:
    """Measure the scale by the layout of photographs and their positions.

    Args:
        layout: ``[m]`` points below the cameras in pixels, y down (see
            ``vehanchor_flight.layout``).
        places: ``[m, 2]`` metres east and north, NaN for unknown ones.
        width_px: width of a photograph, in these pixels.

    Returns:
        The witness; None for fewer than two positions, or if layout and positions differ.
    """
    known = np.isfinite(places).all(axis=1)
    seen = layout[known]
    taken = places[known, 0] - 1j * places[known, 1]
    if len(seen) < _LEAST:
        return None
    weight = np.ones(len(seen))
    for _ in range(_STEPS):
        total = weight.sum()
        in_px = seen - (weight @ seen) / total
        in_m = taken - (weight @ taken) / total
        spread_px = float(weight @ np.abs(in_px) ** 2)
        spread_m = float(weight @ np.abs(in_m) ** 2)
        if spread_px <= 0 or spread_m <= 0:
            return None
        product = complex(weight @ (np.conj(in_px) * in_m))
        # rounding can exceed 1
        agreement = min(1.0, abs(product) / math.sqrt(spread_px * spread_m))
        # both have errors: geometric mean of the two regressions
        gsd = math.sqrt(spread_m / spread_px)
        off = np.abs(in_m - gsd * (product / max(abs(product), 1e-12)) * in_px)
        # 0.8326: median of a Rayleigh distribution over its scale, / sqrt 2
        typical = max(float(np.median(off)) / 0.8326, 1e-6)
        weight = 1.0 / (1.0 + (off / (_REACH * typical)) ** 2) ** 2
    n = float(weight.sum())
    if agreement < _LEAST_AGREEMENT or n < _LEAST - 0.5:
        return None
    radius = math.sqrt(spread_m / n)
    stated_sd = math.hypot(_POSITION_SD_M, _AIM_SHARE * width_px * gsd) / (radius * math.sqrt(n))
    seen_sd = math.sqrt((1 - agreement**2) / (2 * max(n - 2, 0.5))) / agreement
    if not on_grid(gsd):
        return None
    n_known = int(known.sum())
    reliability = RELIABILITY[Positions.kind]
    log_sd = math.hypot(max(stated_sd, seen_sd), reliability.log_sd)
    said = f"The positions of {n_known} overlapping photographs give {{}}."
    return point_witness(
        Positions.kind,
        gsd,
        log_sd=log_sd,
        chance_wrong=reliability.chance_wrong,
        statement=said,
        n=n_known,
    )
