"""One scale of several rulers, and which of them agree with it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.scale.fusion import GRID, credible_interval, mass_within, product
from vehanchor.scale.lengths import Interval

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.anchors.evidence import Evidence

__all__ = ["FusedScale", "RulerShare", "fuse_rulers"]

_TOLERANCE = 0.2
_BASIN = 0.25  # of log scale on either side of the highest cell: what belongs to one mode
_AGREEMENT = 0.1  # a ruler agrees with a scale that its interval holds, or that is this near to its own
_Z95 = 1.959963984540054


class RulerShare(NamedTuple):
    """One ruler's part in a scale.

    Attributes:
        kind: of the ruler.
        gsd_m_per_px: what it says by itself.
        interval: its own 95 % interval.
        n: how many things it was measured on.
        weight: 0..1, its share of the precision among those that agree; 0 for one that does not. They add up to 1.
        agrees: with the scale of all.
    """

    kind: str
    gsd_m_per_px: float
    interval: Interval
    n: int
    weight: float
    agrees: bool


class FusedScale(NamedTuple):
    """What all rulers say together.

    Attributes:
        gsd_m_per_px: metres per pixel: the median of the strongest mode.
        interval: that holds 95 % of the posterior, and the scale given out.
        p_within_20: chance that the scale given out is off by less than a fifth.
        leading: kind of the ruler with the largest weight.
        rulers: all that found something, in their order.
    """

    gsd_m_per_px: float
    interval: Interval
    p_within_20: float
    leading: str
    rulers: tuple[RulerShare, ...]


def fuse_rulers(evidence: Sequence[Evidence]) -> FusedScale | None:
    """Multiply the densities of all rulers that have one.

    Args:
        evidence: of all rulers.

    Returns:
        The scale of all; None where nobody found anything.
    """
    found = [(each, each.density) for each in evidence if each.gsd_m_per_px is not None and each.density is not None]
    if not found:
        return None
    posterior = product(*(density for _, density in found))
    gsd = _strongest(posterior)
    low, high = credible_interval(posterior)
    interval = Interval(min(low, gsd), max(high, gsd))
    precisions = [_precision(each, gsd) for each, _ in found]
    total = sum(precisions) or 1.0
    rulers = tuple(
        RulerShare(
            each.kind, each.gsd_m_per_px or gsd, each.interval or interval, each.n, precision / total, precision > 0
        )
        for (each, _), precision in zip(found, precisions, strict=True)
    )
    leading = max(rulers, key=lambda ruler: ruler.weight).kind
    return FusedScale(gsd, interval, mass_within(posterior, gsd, _TOLERANCE), leading, rulers)


def _strongest(posterior: NDArray[np.float64]) -> float:
    """The median of the mode with the highest cell, metres per pixel."""
    near = np.abs(GRID - GRID[int(np.argmax(posterior))]) <= _BASIN
    inside = np.where(near, posterior, 0.0)
    return credible_interval(inside / inside.sum(), probability=0.0).low


def _precision(one: Evidence, gsd_m_per_px: float) -> float:
    """Inverse of the square of a ruler's spread; 0 where it does not agree with a scale."""
    if one.gsd_m_per_px is None or one.interval is None:
        return 0.0
    held = one.interval.low <= gsd_m_per_px <= one.interval.high
    if not held and abs(math.log(one.gsd_m_per_px / gsd_m_per_px)) > math.log1p(_AGREEMENT):
        return 0.0
    spread = math.log(one.interval.high / one.interval.low) / (2 * _Z95)
    return 1.0 / max(spread, 1e-3) ** 2
