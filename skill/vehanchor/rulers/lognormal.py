"""Point estimate with lognormal error: the evidence of most rulers."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.rulers.evidence import Evidence, Fact
from vehanchor.scale.fusion import GRID, LOG_STEP, TOLERANCE, mass_within, strongest_mode, with_outlier_floor
from vehanchor.scale.lengths import Z95, Interval

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.options import Basis
    from vehanchor.records import Notice
    from vehanchor.rulers.evidence import Mark


@dataclass(frozen=True, eq=False)
class LognormalEvidence(Evidence):
    """Scale with its own spread.

    Attributes:
        log_sd: standard deviation of the scale's log; None if the ruler found nothing.
        chance_wrong: 0..1, chance of an outlier.
    """

    log_sd: float | None = None
    chance_wrong: float = 0.0

    def stated(self, name: str, basis: Basis, family: str = "") -> LognormalEvidence:
        """Mark the evidence as that of one fact from the caller (``Fact``)."""
        assert self.gsd_m_per_px is not None
        assert self.interval is not None
        return replace(self, facts=(Fact(name, basis, self.gsd_m_per_px, self.interval, self.confidence, family),))


def lognormal(gsd_m_per_px: float, log_sd: float) -> NDArray[np.float64]:
    """Make a lognormal density on the grid.

    Args:
        gsd_m_per_px: its median, on the grid (see ``on_grid``).
        log_sd: standard deviation of its log, at least one cell.

    Returns:
        ``[g]`` probabilities.
    """
    off = (GRID - math.log(gsd_m_per_px)) / max(log_sd, LOG_STEP)
    density = np.exp(-0.5 * off**2)
    return np.asarray(density / density.sum())


def on_grid(gsd_m_per_px: float) -> bool:
    """Tell whether a scale is possible: 3 mm to 3 m per pixel."""
    return gsd_m_per_px > 0 and bool(GRID[0] <= math.log(gsd_m_per_px) <= GRID[-1])


def lognormal_evidence(
    kind: str,
    gsd_m_per_px: float,
    log_sd: float,
    chance_wrong: float,
    said: str,
    *,
    n: int = 1,
    notices: Sequence[Notice] = (),
    marks: Sequence[Mark] = (),
) -> LognormalEvidence:
    """Make evidence from a scale and its standard deviation.

    Args:
        kind: of the ruler.
        gsd_m_per_px: the scale.
        log_sd: standard deviation of its log.
        chance_wrong: 0..1, chance of an outlier.
        said: a sentence with the source and the measurement; ``{}`` in it stands for the scale.
        n: number of things measured.
        notices: warnings.
        marks: measured lines, for pictures.
    """
    reach = math.exp(Z95 * log_sd)
    interval = Interval(gsd_m_per_px / reach, gsd_m_per_px * reach)
    density = with_outlier_floor(lognormal(gsd_m_per_px, log_sd), chance_wrong)
    return LognormalEvidence(
        kind=kind,
        gsd_m_per_px=gsd_m_per_px,
        interval=interval,
        n=n,
        confidence=min(1.0, max(0.0, mass_within(density, gsd_m_per_px, TOLERANCE))),
        notices=tuple(notices),
        density=density,
        explanation=said.replace("{}", _words(gsd_m_per_px, interval)),
        marks=tuple(marks),
        log_sd=log_sd,
        chance_wrong=chance_wrong,
    )


def combined(each: Sequence[LognormalEvidence]) -> LognormalEvidence:
    """Multiply evidence of one kind, as of several lines; contradictions show as several modes.

    Args:
        each: evidence with a scale, at least one. A single one is returned unchanged.
    """
    if len(each) == 1:
        return each[0]
    gsd, interval, density = strongest_mode([one.density for one in each if one.density is not None])
    return replace(
        each[0],
        gsd_m_per_px=gsd,
        interval=interval,
        n=sum(one.n for one in each),
        confidence=min(1.0, max(0.0, mass_within(density, gsd, TOLERANCE))),
        density=density,
        explanation=_words(gsd, interval),
        log_sd=math.log(interval.high / interval.low) / (2 * Z95),
        facts=tuple(fact for one in each for fact in one.facts),
    )


def mixture(each: Sequence[LognormalEvidence], weights: Sequence[float]) -> LognormalEvidence:
    """Mix evidence of alternatives, as the widths of a thing in several countries.

    Args:
        each: evidence by alternative, at least one. A single one is returned unchanged.
        weights: their relative probabilities.
    """
    if len(each) == 1:
        return each[0]
    parts = [
        weight / sum(weights) * one.density
        for one, weight in zip(each, weights, strict=True)
        if one.density is not None
    ]
    gsd, interval, density = strongest_mode([np.sum(parts, axis=0)])
    return replace(
        each[0],
        gsd_m_per_px=gsd,
        interval=interval,
        confidence=min(1.0, max(0.0, mass_within(density, gsd, TOLERANCE))),
        density=density,
        explanation=_words(gsd, interval),
        log_sd=math.log(interval.high / interval.low) / (2 * Z95),
    )


def _words(gsd_m_per_px: float, interval: Interval) -> str:
    return f"{gsd_m_per_px:.4g} m/px ({interval.low:.3g} to {interval.high:.3g})"


def no_evidence(kind: str, *notices: Notice) -> LognormalEvidence:
    """Make the evidence of a ruler that found nothing; notices say why."""
    return LognormalEvidence(kind=kind, gsd_m_per_px=None, interval=None, n=0, confidence=0.0, notices=notices)
