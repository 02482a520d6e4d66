"""Heights above the sea as a ruler: how high the ground lies below photographs of known scale, it lies below others.

A camera of focal length ``f`` pixels whose pixels are ``s`` metres wide is ``s f`` metres above the ground. What is
left of its height above the sea is the ground's, and photographs of the same flight that nothing ties to the first, on
which nothing else is found, were taken above much the same ground.
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

    from vehanchor.flight.photograph import Photograph
    from vehanchor.records import GsdEstimate
    from vehanchor.rulers.evidence import Evidence

_ALTITUDE_SD_M = 3.0  # of one receiver between two places
_CHANCE_WRONG = 0.05
_LEAST_HEIGHT_M = 5.0
_MOST_RATIO = 3.0  # of the heights of two photographs: beyond it is another place, or another zero of heights


class Ground(NamedTuple):
    """The ground below photographs of known scale.

    Attributes:
        sea_m: its height above the sea, as their receiver counts it.
        above_m: how high they were taken above it.
        log_sd: standard deviation of the log of that, by their scale.
        n: photographs.
    """

    sea_m: float
    above_m: float
    log_sd: float
    n: int


class _Stood(NamedTuple):
    """Where a camera stood: metres above the sea, and its focal length in pixels of the image with its spread."""

    sea_m: float
    focal_px: float
    focal_log_sd: float


def _stood(photograph: Photograph) -> _Stood | None:
    """None if the metadata lack height or lens, or if the camera was tilted."""
    image = photograph.view.image
    camera = image.camera
    if camera is None or camera.altitude_m is None or photograph.analysis.estimate.tilt is not None:
        return None
    seen = lens(image, camera)
    return None if seen is None else _Stood(camera.altitude_m, seen.pixels, seen.log_sd)


def ground_below(members: Sequence[Photograph], offsets: NDArray[np.float64], pooled: GsdEstimate) -> Ground | None:
    """How high the ground lies below photographs whose scale may be used.

    Args:
        members: of one island.
        offsets: ``[n]`` log of how much larger a pixel of each is than one of the pixels that the scale is in.
        pooled: what all of them say together.

    Returns:
        None without such a scale, or where no metadata tell heights and lenses.
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
    """Evidence for an island on which nothing else is found, in the pixels of its reference.

    Args:
        grounds: below other islands of the flight.
        members: of this one.
        offsets: as in ``ground_below``.

    Returns:
        One, or none where nothing tells it.
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
    share = source.above_m / middle  # of the height that is the other's
    lens_sd = stood[0][0].focal_log_sd * abs(1 - share)  # it cancels where both are as high
    log_sd = math.hypot(GROUND_LOG_SD, _ALTITUDE_SD_M / middle, source.log_sd * share, lens_sd)
    said = f"Heights above the sea, with the ground as it lies below {sources} photographs of known scale, say {{}}."
    return (lognormal_evidence(Positions.kind, gsd, log_sd, _CHANCE_WRONG, said, n=len(stood)),)
