"""Heights above sea level as a ruler: the ground below photographs of known scale serves unlinked photographs.

A camera with focal length ``f`` pixels and ``s`` metres per pixel is ``s f`` metres above the ground. Its height above
sea level less ``s f`` is the height of the ground. A component of the same flight without other evidence is assumed to
lie at the same height.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.imagery.metadata.lens import lens
from vehanchor.rulers.lognormal import lognormal_evidence, on_grid
from vehanchor.rulers.positions import Positions
from vehanchor.scale.height import GROUND_LOG_SD
from vehanchor.scale.lengths import Z95

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.records import GsdEstimate
    from vehanchor.rulers.evidence import Evidence
    from vehanchor_flight.photograph import Photograph

_ALTITUDE_SD_M = 3.0  # of the difference of two altitudes from one receiver
_CHANCE_WRONG = 0.05
_LEAST_HEIGHT_M = 5.0
_MOST_RATIO = 3.0  # of the heights of two photographs: beyond it, the place or the zero of altitude differs


class Ground(NamedTuple):
    """Ground below photographs of known scale.

    Attributes:
        sea_m: its height above sea level by the photographs' receiver, metres.
        above_m: height of the cameras above it, metres.
        log_sd: standard deviation of the log of ``above_m``, from the scale.
        n: number of photographs.
    """

    sea_m: float
    above_m: float
    log_sd: float
    n: int


class _Stood(NamedTuple):
    """Camera altitude above sea level, metres, and focal length, pixels of the image, with its spread."""

    sea_m: float
    focal_px: float
    focal_log_sd: float


def _stood(photograph: Photograph) -> _Stood | None:
    """Read altitude and focal length; None if the metadata lack one of them, or for a tilted camera."""
    image = photograph.view.image
    camera = image.camera
    if camera is None or camera.altitude_m is None or photograph.analysis.estimate.tilt is not None:
        return None
    seen = lens(image, camera)
    return None if seen is None else _Stood(camera.altitude_m, seen.pixels, seen.log_sd)


def ground_below(members: Sequence[Photograph], offsets: NDArray[np.float64], pooled: GsdEstimate) -> Ground | None:
    """Compute the height of the ground below photographs with a usable scale.

    Args:
        members: photographs of one component.
        offsets: ``[n]`` logs of each member's metres per pixel over the reference's.
        pooled: estimate of the reference's scale from all members.

    Returns:
        None without a usable scale, or if no metadata have altitude and focal length.
    """
    low, high = pooled.gsd_ci95_low_m_per_px, pooled.gsd_ci95_high_m_per_px
    if pooled.status != "ok" or pooled.gsd_m_per_px is None or not low or not high:
        return None
    stood = [(each, offset) for member, offset in zip(members, offsets, strict=True) if (each := _stood(member))]
    if not stood:
        return None
    above = np.array([pooled.gsd_m_per_px * math.exp(offset) * each.focal_px for each, offset in stood])
    sea = np.array([each.sea_m for each, _ in stood])
    spread = math.log(high / low) / (2 * Z95)
    return Ground(float(np.median(sea - above)), float(np.median(above)), spread, len(stood))


def heights_evidence(
    grounds: Sequence[Ground], members: Sequence[Photograph], offsets: NDArray[np.float64]
) -> tuple[Evidence, ...]:
    """Make evidence for a component without other evidence, in the pixels of its reference.

    Args:
        grounds: ground below other components of the flight.
        members: photographs of this component.
        offsets: as in ``ground_below``.

    Returns:
        At most one piece of evidence.
    """
    stood = [(each, offset) for member, offset in zip(members, offsets, strict=True) if (each := _stood(member))]
    if not grounds or not stood:
        return ()
    sources = sum(ground.n for ground in grounds)
    sea = sum(ground.sea_m * ground.n for ground in grounds) / sources
    source = max(grounds, key=lambda ground: ground.n)
    above = [each.sea_m - sea for each, _ in stood]
    middle = float(np.median(above))
    if min(above) < _LEAST_HEIGHT_M or not 1 / _MOST_RATIO <= middle / source.above_m <= _MOST_RATIO:
        return ()
    logs = [math.log(height / each.focal_px) - offset for height, (each, offset) in zip(above, stood, strict=True)]
    gsd = math.exp(float(np.median(logs)))
    if not on_grid(gsd):
        return ()
    share = source.above_m / middle  # error of the other component's height, relative to this one's
    lens_sd = stood[0][0].focal_log_sd * abs(1 - share)  # cancels if both heights are equal
    log_sd = math.hypot(GROUND_LOG_SD, _ALTITUDE_SD_M / middle, source.log_sd * share, lens_sd)
    said = f"Altitudes above sea level, with the ground below {sources} photographs of known scale, give {{}}."
    return (lognormal_evidence(Positions.kind, gsd, log_sd, _CHANCE_WRONG, said, n=len(stood)),)
