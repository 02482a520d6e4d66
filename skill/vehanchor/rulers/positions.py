"""Positions as a ruler: distances between photographs of a flight, in metres over pixels."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.rulers.ruler import Ruler, point_witness
from vehanchor.scale.density import on_grid
from vehanchor.scale.reliability import RELIABILITY

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.imagery.facts import ImageFacts
    from vehanchor.rulers.ruler import View
    from vehanchor.scale.posterior import Witness

    EastNorth: TypeAlias = NDArray[np.float64]
    """``[n, 2]`` metres east and north, NaN if unknown."""

    ComplexPoints: TypeAlias = NDArray[np.complex128]
    """``[n]`` points x + iy."""

_EARTH_M = 6_371_009.0
_MIN_POSITIONS = 2
# Error of a small receiver, relative to the neighbouring photograph.
_POSITION_SD_M = 2.0
# Error along the way of flight: the receiver's position is older than the picture, or newer, by a
# second at the fifteen metres per second of a fixed wing. Photographs on one heading share it;
# others are moved apart, or together. A choice. In one flight the positions of four photographs on
# headings up to 170 degrees apart give 1.66 times the scale, as a lag of 20 to 25 m would.
_LAG_M = 15.0
# Offset of a picture's centre by a tilt of three degrees, as a share of its width.
_AIM_SHARE = 0.05
# Least agreement of layout and positions; below, they do not match.
_MIN_AGREEMENT = 0.9
# Positions that are off by more than three times the typical error lose most of their weight.
_REACH = 3.0
_N_STEPS = 10
# Median of a Rayleigh distribution over its root mean square: the root of ln 2.
_MEDIAN_OVER_RMS = 0.8326


class Positions(Ruler):
    """Positions in the metadata of photographs; a flight measures them with ``baseline``."""

    kind = "positions"
    label = "positions of the photographs"
    plural = True
    help = "photographs of a flight with positions in their metadata"
    colour = "#56B4E9"
    reads_metadata = True
    uses_plane = True

    def measure(self, view: View) -> Witness | None:  # noqa: ARG002
        """Measure nothing: a single image has no baseline."""
        return None


def camera_positions_m(images: Sequence[ImageFacts]) -> EastNorth | None:
    """Read the positions of photographs.

    Args:
        images: their facts.

    Returns:
        ``[n, 2]`` metres east and north of the first known position, NaN for unknown ones; None if
        all are unknown.
    """
    shape = (len(images), 2)
    degrees = np.full(shape, math.nan)
    for k, image in enumerate(images):
        camera = image.camera
        if camera is None:
            continue
        if camera.latitude_deg is None or camera.longitude_deg is None:
            continue
        degrees[k] = camera.latitude_deg, camera.longitude_deg
    is_known = np.isfinite(degrees[:, 0])
    known = np.flatnonzero(is_known)
    if len(known) == 0:
        return None
    first = degrees[known[0]]
    north, east = np.radians(degrees - first).T
    # Across the 180th meridian, longitudes jump by a full turn.
    full_turn = 2 * math.pi
    east = np.where(east > math.pi, east - full_turn, east)
    east = np.where(east < -math.pi, east + full_turn, east)
    # A degree of longitude is shorter by the cosine of the latitude.
    latitude = math.radians(first[0])
    east = east * math.cos(latitude)
    return np.column_stack([east, north]) * _EARTH_M


def baseline(
    layout: ComplexPoints,
    places: EastNorth,
    width_px: float,
    headings: ComplexPoints | None = None,
) -> Witness | None:
    """Measure the scale by the layout of photographs and their positions.

    Args:
        layout: ``[m]`` points below the cameras in pixels, y down (see
            ``vehanchor_flight.layout``).
        places: ``[m, 2]`` metres east and north, NaN for unknown ones.
        width_px: width of a photograph, in these pixels.
        headings: ``[m]`` directions of the photographs, of length 1; None if unknown, or if they
            do not matter.

    Returns:
        The witness; None for fewer than two positions, or if layout and positions differ.
    """
    known = np.isfinite(places).all(axis=1)
    # Complex numbers, for which a rotation is a factor; north is up, and y points down.
    pixels = layout[known]
    east, north = places[known].T
    metres = east - 1j * north
    if len(pixels) < _MIN_POSITIONS:
        return None
    fit = _fit(pixels, metres)
    if fit is None or fit.agreement < _MIN_AGREEMENT:
        return None
    # The number of positions that fit is a sum of weights.
    if fit.n < _MIN_POSITIONS - 0.5:
        return None
    if not on_grid(fit.gsd_m_per_px):
        return None

    # Two estimates of the error: from the receiver and the aim, and from the misfit.
    radius_m = math.sqrt(fit.spread_m2 / fit.n)
    place_sd_m = math.hypot(_POSITION_SD_M, _AIM_SHARE * width_px * fit.gsd_m_per_px)
    expected_sd = place_sd_m / (radius_m * math.sqrt(fit.n))
    degrees_of_freedom = 2 * max(fit.n - 2, 0.5)
    unexplained = 1 - fit.agreement**2
    misfit_sd = math.sqrt(unexplained / degrees_of_freedom) / fit.agreement
    lag_sd = 0.0
    if headings is not None:
        lag_sd = _LAG_M * _stretch_by_lag(pixels, headings[known]) / fit.gsd_m_per_px
    fit_sd = math.hypot(max(expected_sd, misfit_sd), lag_sd)
    reliability = RELIABILITY[Positions.kind]
    n_known = int(known.sum())
    return point_witness(
        Positions.kind,
        fit.gsd_m_per_px,
        log_sd=math.hypot(fit_sd, reliability.log_sd),
        chance_wrong=reliability.chance_wrong,
        statement=f"The positions of {n_known} overlapping photographs give {{}}.",
        n=n_known,
    )


def _stretch_by_lag(pixels: ComplexPoints, headings: ComplexPoints) -> float:
    """Compute by how much a step along the heading of each photograph enlarges their layout.

    Returns:
        The share of a step of one pixel, for the camera's worst turn on the craft.
    """
    offsets = pixels - pixels.mean()
    steps = headings - headings.mean()
    moved = abs(np.vdot(offsets, steps))
    return float(moved / np.vdot(offsets, offsets).real)


class _Fit(NamedTuple):
    """Similarity transform from pixels to metres.

    Attributes:
        gsd_m_per_px: its scale.
        agreement: 0..1, correlation of both sets of points.
        n: sum of the weights, the number of positions that fit.
        spread_m2: weighted sum of squared distances from the centre.
    """

    gsd_m_per_px: float
    agreement: float
    n: float
    spread_m2: float


def _fit(pixels: ComplexPoints, metres: ComplexPoints) -> _Fit | None:
    """Fit a similarity transform to points ``[m]`` by iterated reweighting, robust to outliers.

    Returns:
        The fit; None if the points have no extent.
    """
    weights = np.ones(len(pixels))
    for _ in range(_N_STEPS):
        total = weights.sum()
        in_px = pixels - (weights @ pixels) / total
        in_m = metres - (weights @ metres) / total
        spread_px2 = float(weights @ np.abs(in_px) ** 2)
        spread_m2 = float(weights @ np.abs(in_m) ** 2)
        if spread_px2 <= 0 or spread_m2 <= 0:
            return None
        # The angle of the product is the rotation, and its size gives the correlation of both sets.
        # Rounding can lift the correlation above 1.
        products = np.conj(in_px) * in_m
        product = complex(weights @ products)
        correlation = abs(product) / math.sqrt(spread_px2 * spread_m2)
        agreement = min(1.0, correlation)
        # Both sets have errors: the geometric mean of the two regressions.
        gsd = math.sqrt(spread_m2 / spread_px2)
        rotation = product / max(abs(product), 1e-12)
        errors_m = np.abs(in_m - gsd * rotation * in_px)
        median_m = float(np.median(errors_m))
        typical_m = max(median_m / _MEDIAN_OVER_RMS, 1e-6)
        # Weights of Geman and McClure: a far point counts little, and never drops out abruptly.
        relative_errors = errors_m / (_REACH * typical_m)
        weights = 1.0 / (1.0 + relative_errors**2) ** 2
    n = float(weights.sum())
    return _Fit(gsd, agreement, n=n, spread_m2=spread_m2)
