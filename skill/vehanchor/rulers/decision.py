"""Decide on a scale: from the evidence of all rulers to one value, interval, chance and reason.

The densities of all rulers are multiplied into one posterior. If only vehicles set a scale, the value is the paper's,
``L_ref / P_mode``, and the posterior gives its chance. With fewer than five vehicles it is the posterior's median near
that value: the lengths of few cars vary as much as the scene-scale prior errs, and together they err less. Otherwise
the value is the median of the strongest mode.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.detection.convergence import Convergence
from vehanchor.records.notices import FLEET_DOUBTS, NoticeCode
from vehanchor.rulers.agreement import agrees, disagreements, outvoted_priors
from vehanchor.rulers.stated import MOST_SURE, Verdict, leading_evidence, verdict
from vehanchor.scale.fusion import (
    TOLERANCE,
    USABLE_CHANCE,
    fuse,
    mass_within,
    median_near,
    product,
    strongest_mode,
)
from vehanchor.scale.lengths import MIN_KDE_VEHICLES, Z95, Interval, statistical_log_sds
from vehanchor.scale.thresholds import (
    DISPUTE_CONFIDENCE,
    FALLBACK_CONFIDENCE,
    GUARD_GSD_M_PER_PX,
    UNSURE_CONFIDENCE,
    WIDEST_USABLE,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.records import Reason
    from vehanchor.rulers.evidence import Evidence
    from vehanchor.rulers.vehicles import VehicleEvidence

_WIDEST_OF_UNCALIBRATED = 3.0  # high over low of an interval if the votes are uncalibrated
_LOST_WIDTH = 10.0  # high over low of a prior's interval for an unknown scene: 19 % of the held-out tenth
_CHANCE_MARGIN = 0.03  # early and full searches of nine photographs differed by at most 0.017
_PRIOR_REACH, _PRIOR_SUPPORT = 0.4, 0.1  # a prior supports a scale if it holds a tenth within +-40 %


class RulerShare(NamedTuple):
    """One ruler's part in a scale.

    Attributes:
        kind: of the ruler.
        gsd_m_per_px: its own scale.
        interval: its own 95 % interval.
        n: number of things measured.
        weight: 0..1, its share of the precision of the multiplied densities; 0 for other rulers and for one that
            disagrees. The weights add up to 1.
        agrees: whether it agrees with the scale.
        explanation: the measurement in a sentence; None if not needed.
    """

    kind: str
    gsd_m_per_px: float
    interval: Interval
    n: int
    weight: float
    agrees: bool
    explanation: str | None = None


class ScaleDecision(NamedTuple):
    """Scale and its confidence.

    Attributes:
        gsd_m_per_px: None without a scale.
        interval: holds the true scale in 95 of 100 images; None without a scale.
        p_within_20: chance of an error below a fifth; None without a scale, or if the votes are uncalibrated.
        confidence: ``p_within_20``, limited by the resolution guard and by doubts if vehicles alone set the scale, and
            if the chance is below 0.9 or the interval spans more than a factor of 2. The paper's composite C in the
            preset ``paper``, and of vehicles with uncalibrated votes.
        reason: why the scale is not usable; None if it is.
        source: kind of the ruler with the largest weight that sets the scale; None without a scale.
        rulers: each ruler's part; none without a scale.
        led_by_measured: whether measured facts lead.
    """

    gsd_m_per_px: float | None
    interval: Interval | None
    p_within_20: float | None
    confidence: float
    reason: Reason | None
    source: str | None = None
    rulers: tuple[RulerShare, ...] = ()
    led_by_measured: bool = False


class Posterior(NamedTuple):
    """Value, interval and chance from all rulers, and the kinds of the multiplied densities."""

    gsd_m_per_px: float
    interval: Interval
    p_within_20: float | None
    multiplied: frozenset[str]


def decide(vehicles: VehicleEvidence, others: Sequence[Evidence]) -> ScaleDecision:
    """Decide on the scale of an image.

    Args:
        vehicles: their evidence.
        others: evidence of the other rulers.

    Returns:
        The decision. For vehicles alone with uncalibrated votes, it has their own interval and confidence.
    """
    evidence = (vehicles, *others)
    alone = not any(each.sets_scale and each.fusable_density is not None for each in others)
    image_gsd = None if alone else _usable_without_facts(vehicles, others)
    leading = None if alone else leading_evidence(evidence, image_gsd)
    posterior = _posterior_of_vehicles(vehicles, others) if alone else fuse_rulers(leading or evidence)
    if posterior is None:
        return ScaleDecision(None, None, None, vehicles.confidence, _vehicle_reason(vehicles, others))
    gsd, interval, chance, multiplied = posterior
    rulers = shares(evidence, gsd, multiplied)
    limit = Verdict() if leading else verdict(evidence, gsd, image_gsd)
    if chance is not None:
        chance = min(chance, limit.chance, MOST_SURE)
    confidence = vehicles.confidence if chance is None else chance
    if not leading:
        confidence = min(confidence, _undisputed_confidence(vehicles, others, rulers))
    if alone and not vehicles.exact:
        confidence = min(confidence, vehicles.largest_confidence)
    widest = WIDEST_USABLE if chance is not None else _WIDEST_OF_UNCALIBRATED
    uncertain = (chance is not None and chance < USABLE_CHANCE) or interval.high > widest * interval.low
    if not vehicles.exact:
        confidence = min(confidence, UNSURE_CONFIDENCE if uncertain or limit.reason else MOST_SURE)
    if vehicles.stretched:  # no ruler gives one scale for both directions
        confidence = min(confidence, DISPUTE_CONFIDENCE)
    reason: Reason | None = None
    if confidence < FALLBACK_CONFIDENCE:
        own = _vehicle_reason(vehicles, others, chance) if alone else _fused_reason(evidence, rulers)
        reason = "stretched" if vehicles.stretched else limit.reason or own
    led = leading is not None
    return ScaleDecision(gsd, interval, chance, confidence, reason, _leading(evidence, rulers), rulers, led)


def convergence(vehicles: VehicleEvidence, priors: Sequence[Evidence]) -> Convergence:
    """Decide whether more vehicles would narrow the scale found so far.

    Args:
        vehicles: their evidence.
        priors: evidence of rulers that cannot set the scale.

    Returns:
        Width of the interval, and whether the scale is usable.
    """
    if vehicles.mode_length_px is None:
        return Convergence(math.inf, 0.0, doubted=True)
    scores = vehicles.fleet.scores if vehicles.aggregation == "weighted_kde" else None
    resampling, spread = statistical_log_sds(vehicles.fleet.lengths, vehicles.mode_length_px, scores=scores)
    statistical = math.hypot(resampling, spread)
    doubts = any(notice.code in FLEET_DOUBTS for notice in vehicles.notices)
    densities = [prior.density for prior in priors if prior.density is not None]
    return Convergence(
        statistical,
        max(vehicles.reference.log_sds),
        doubted=doubts or vehicles.guarded or not _is_settled(decide(vehicles, priors)),
        value_log_sd=math.hypot(resampling, vehicles.reference.sampling_log_sd)
        if vehicles.n >= MIN_KDE_VEHICLES
        else math.inf,
        density=None if vehicles.density is None else product(vehicles.density, *densities),
    )


def _is_settled(decision: ScaleDecision) -> bool:
    """Test whether a little change of the value leaves the status as it is: usable, or clearly too imprecise."""
    chance = decision.p_within_20
    clearly = chance is not None and chance < USABLE_CHANCE - _CHANCE_MARGIN
    return decision.reason is None or (decision.reason == "imprecise" and clearly)


def ruler_densities(evidence: Iterable[Evidence]) -> dict[str, NDArray[np.float64]]:
    """Collect the densities to multiply (``vehanchor.scale.fusion.product``).

    Args:
        evidence: of all rulers of an image.

    Returns:
        ``[g]`` probabilities on ``vehanchor.scale.fusion.GRID`` by kind of ruler, without rulers that found nothing.
    """
    found = ((each.kind, each.fusable_density) for each in evidence if each.gsd_m_per_px is not None)
    return {kind: density for kind, density in found if density is not None}


def fuse_rulers(evidence: Sequence[Evidence]) -> Posterior | None:
    """Multiply the densities of all rulers; the value is the median of the strongest mode.

    A prior that contradicts rulers which agree with each other is left out.

    Args:
        evidence: of all rulers, priors included.

    Returns:
        None if no ruler that sets a scale found anything.
    """
    outvoted = outvoted_priors(evidence)
    densities = ruler_densities(each for each in evidence if each.kind not in outvoted)
    if not any(each.sets_scale and each.kind in densities for each in evidence):
        return None
    gsd, interval, posterior = strongest_mode(list(densities.values()))
    return Posterior(gsd, interval, mass_within(posterior, gsd, TOLERANCE), frozenset(densities))


def shares(evidence: Sequence[Evidence], gsd_m_per_px: float, multiplied: frozenset[str]) -> tuple[RulerShare, ...]:
    """Compare each ruler with the fused scale.

    Args:
        evidence: of all rulers.
        gsd_m_per_px: the fused scale.
        multiplied: kinds of the multiplied densities.

    Returns:
        One share for each ruler with a density, in their order.
    """
    densities = ruler_densities(evidence)
    found = [(each, each.gsd_m_per_px, each.interval) for each in evidence if each.kind in densities]
    agreed = {each.kind for each, _, _ in found if agrees(each, gsd_m_per_px)}
    precisions = {
        each.kind: _precision(interval)
        for each, _, interval in found
        if interval is not None and each.kind in agreed & multiplied
    }
    total = sum(precisions.values()) or 1.0
    return tuple(
        RulerShare(
            each.kind,
            gsd,
            interval,
            each.n,
            precisions.get(each.kind, 0.0) / total,
            each.kind in agreed,
            each.explanation,
        )
        for each, gsd, interval in found
        if gsd is not None and interval is not None
    )


def _usable_without_facts(vehicles: VehicleEvidence, others: Sequence[Evidence]) -> float | None:
    """Return the scale that the image gives without stated facts if it is usable, else None."""
    unstated = [each for each in others if not each.facts]
    if len(unstated) == len(others):
        return None
    decision = decide(vehicles, unstated)
    return decision.gsd_m_per_px if decision.reason is None else None


def _undisputed_confidence(
    vehicles: VehicleEvidence, others: Sequence[Evidence], rulers: Sequence[RulerShare]
) -> float:
    """Compute the confidence without the rulers that disagree: a contradiction never raises it."""
    outvoted = {ruler.kind for ruler in rulers if not ruler.agrees}
    kept = [each for each in others if not each.sets_scale or each.kind not in outvoted]
    if not outvoted or (len(kept) == len(others) and vehicles.kind not in outvoted):
        return 1.0
    if vehicles.kind not in outvoted and vehicles.gsd_m_per_px is not None:
        return decide(vehicles, kept).confidence
    posterior = fuse_rulers(kept)
    return 1.0 if posterior is None or posterior.p_within_20 is None else posterior.p_within_20


def _posterior_of_vehicles(vehicles: VehicleEvidence, priors: Sequence[Evidence]) -> Posterior | None:
    """Choose the value of vehicles alone, with a chance from the product of their density and the priors'."""
    gsd, interval = vehicles.gsd_m_per_px, vehicles.interval
    if gsd is None or interval is None:
        return None
    multiplied = frozenset({vehicles.kind})
    if vehicles.density is None:
        return Posterior(gsd, interval, None, multiplied)
    found = {prior.kind: prior.density for prior in priors if prior.density is not None}
    if found and vehicles.n < MIN_KDE_VEHICLES:
        gsd, multiplied = median_near(gsd, product(vehicles.density, *found.values())), multiplied | set(found)
    judged = fuse(gsd, vehicles.density, *found.values(), sharpness=vehicles.sharpness)
    return Posterior(gsd, judged.interval, judged.p_within_20, multiplied)


def _leading(evidence: Sequence[Evidence], rulers: Sequence[RulerShare]) -> str | None:
    able = {each.kind for each in evidence if each.sets_scale}
    heaviest = max(rulers, key=lambda ruler: (ruler.kind in able, ruler.weight), default=None)
    return heaviest and heaviest.kind


def _fused_reason(evidence: Sequence[Evidence], rulers: Sequence[RulerShare]) -> Reason:
    able = {each.kind for each in evidence if each.sets_scale}
    outvoted = any(not ruler.agrees for ruler in rulers if ruler.kind in able)
    return "disagree" if outvoted or disagreements(evidence) else "imprecise"


def _vehicle_reason(vehicles: VehicleEvidence, priors: Sequence[Evidence], chance: float | None = None) -> Reason:
    """Choose the first of: too few pixels, a contradicting prior, not cars, an unknown scene, too few, imprecise."""
    prior = next((each for each in priors if each.interval is not None), None)
    lost = prior is not None and prior.interval is not None and prior.interval.high > _LOST_WIDTH * prior.interval.low
    if vehicles.gsd_m_per_px is None:
        coarse = prior is not None and prior.interval is not None and prior.interval.low > GUARD_GSD_M_PER_PX
        return "too_coarse" if coarse else "lost" if lost else "too_few"
    if vehicles.guarded:
        return "too_coarse"
    apart = any(notice.code == NoticeCode.LENGTHS_DISAGREE for notice in vehicles.notices)
    if apart or (prior is not None and not _supports(prior, vehicles.gsd_m_per_px)):
        return "disagree"
    if vehicles.disputed:
        return "not_cars"
    if chance is not None and (chance >= USABLE_CHANCE or vehicles.n >= MIN_KDE_VEHICLES):
        return "imprecise"
    return "lost" if lost and vehicles.n < MIN_KDE_VEHICLES else "too_few"


def _supports(prior: Evidence, gsd_m_per_px: float) -> bool:
    return prior.density is None or mass_within(prior.density, gsd_m_per_px, _PRIOR_REACH) >= _PRIOR_SUPPORT


def _precision(interval: Interval) -> float:
    """Compute the precision of an interval, the inverse square of its spread."""
    spread = math.log(interval.high / interval.low) / (2 * Z95)
    return 1.0 / max(spread, 1e-3) ** 2
