"""One scale of several rulers, and which of them agree with it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.scale.fusion import GRID, LOG_STEP, TOLERANCE, credible_interval, mass_within, product
from vehanchor.scale.lengths import Z95, Interval

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.rulers.evidence import Evidence

_BASIN = 0.25  # of log scale on either side of the highest cell: what belongs to one mode
_WINDOW = 0.2  # the same, of what makes one mode stronger than another
_AGREEMENT = 0.1  # a ruler agrees with a scale that its interval holds, or that is this near to its own


class RulerShare(NamedTuple):
    """One ruler's part in a scale.

    Attributes:
        kind: of the ruler.
        gsd_m_per_px: what it says by itself.
        interval: its own 95 % interval.
        n: how many things it was measured on.
        weight: 0..1, its share of the precision among those that agree; 0 for one that does not. They add up to 1.
        agrees: with the scale of all.
        explanation: what it was measured by, in a sentence; None for one that has no more to say.
    """

    kind: str
    gsd_m_per_px: float
    interval: Interval
    n: int
    weight: float
    agrees: bool
    explanation: str | None = None


class FusedScale(NamedTuple):
    """What all rulers say together.

    Attributes:
        gsd_m_per_px: metres per pixel: the median of the strongest mode.
        interval: that holds the true scale in 95 of 100 images in which not all rulers are wrong, and the scale given
            out.
        p_within_20: chance that the scale given out is off by less than a fifth.
        leading: kind of the ruler with the largest weight, of those that can make a scale by themselves.
        rulers: all that found something, in their order.
    """

    gsd_m_per_px: float
    interval: Interval
    p_within_20: float
    leading: str
    rulers: tuple[RulerShare, ...]


def able_rulers(evidence: Sequence[Evidence]) -> list[Evidence]:
    """Evidence that can make a scale by itself: something was found, and its ruler is no mere witness."""
    return [each for each in evidence if each.gsd_m_per_px is not None and each.confidence > 0]


def ruler_densities(evidence: Sequence[Evidence]) -> dict[str, NDArray[np.float64]]:
    """What each ruler says among others, ready to be multiplied (``vehanchor.scale.fusion.product``).

    Args:
        evidence: of all rulers of an image.

    Returns:
        ``[g]`` probabilities on ``vehanchor.scale.fusion.GRID`` by the kind of the ruler; those that found nothing are
        left out.
    """
    found = ((each.kind, each.fusable_density) for each in evidence if each.gsd_m_per_px is not None)
    return {kind: density for kind, density in found if density is not None}


def fuse_rulers(evidence: Sequence[Evidence]) -> FusedScale | None:
    """Multiply the densities of all rulers that have one.

    Args:
        evidence: of all rulers, witnesses included.

    Returns:
        The scale of all; None where nobody found anything, or witnesses alone.
    """
    densities = ruler_densities(evidence)
    found = [each for each in evidence if each.kind in densities]
    if not able_rulers(found):
        return None
    posterior = product(*densities.values())
    gsd = _strongest(posterior)
    low, high = credible_interval(_someone_right(list(densities.values())))
    interval = Interval(min(low, gsd), max(high, gsd))
    rulers = shares(found, gsd)
    able = {each.kind for each in able_rulers(found)}
    leading = max((ruler for ruler in rulers if ruler.kind in able), key=lambda ruler: ruler.weight).kind
    return FusedScale(gsd, interval, mass_within(posterior, gsd, TOLERANCE), leading, rulers)


def shares(evidence: Sequence[Evidence], gsd_m_per_px: float) -> tuple[RulerShare, ...]:
    """Hold each ruler against the scale that is given out.

    Args:
        evidence: of all rulers.
        gsd_m_per_px: the scale.

    Returns:
        One for each that found something, in their order.
    """
    found = [each for each in evidence if each.gsd_m_per_px is not None and each.interval is not None]
    precisions = [_precision(each, gsd_m_per_px) for each in found]
    total = sum(precisions) or 1.0
    return tuple(
        RulerShare(
            each.kind,
            each.gsd_m_per_px or gsd_m_per_px,
            each.interval or Interval(gsd_m_per_px, gsd_m_per_px),
            each.n,
            precision / total,
            precision > 0,
            each.explanation,
        )
        for each, precision in zip(found, precisions, strict=True)
    )


def _someone_right(densities: list[NDArray[np.float64]]) -> NDArray[np.float64]:
    """The posterior given that not all rulers are wrong at once.

    A ruler that may be wrong is mixed with a floor that says nothing. Where all of them are, nothing at all is known:
    that belongs into the chance of being right, not into an interval, which it would stretch over the whole grid.
    """
    logs = np.sum([np.log(np.maximum(density, 1e-300)) for density in densities], axis=0)
    all_wrong = sum(math.log(max(float(density.min()), 1e-300)) for density in densities)
    right = np.maximum(np.exp(logs - logs.max()) - math.exp(all_wrong - logs.max()), 0.0)
    return np.asarray(right / right.sum())


def _strongest(posterior: NDArray[np.float64]) -> float:
    """The median of the mode that has most of the posterior, metres per pixel."""
    reach = round(_WINDOW / LOG_STEP)
    below = np.concatenate([np.zeros(reach + 1), np.cumsum(posterior), np.full(reach, posterior.sum())])
    middle = int(np.argmax(below[2 * reach + 1 :] - below[: len(posterior)]))
    inside = slice(max(0, middle - reach), middle + reach + 1)
    peak = GRID[inside][int(np.argmax(posterior[inside]))]
    mode = np.where(np.abs(GRID - peak) <= _BASIN, posterior, 0.0)
    return credible_interval(mode / mode.sum(), probability=0.0).low


def _precision(one: Evidence, gsd_m_per_px: float) -> float:
    """Inverse of the square of a ruler's spread; 0 where it does not agree with a scale."""
    if one.gsd_m_per_px is None or one.interval is None:
        return 0.0
    held = one.interval.low <= gsd_m_per_px <= one.interval.high
    if not held and abs(math.log(one.gsd_m_per_px / gsd_m_per_px)) > math.log1p(_AGREEMENT):
        return 0.0
    spread = math.log(one.interval.high / one.interval.low) / (2 * Z95)
    return 1.0 / max(spread, 1e-3) ** 2
