"""The judgement of a scale: how far it may be used, by what all rulers say, and why not further."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple, cast

from vehanchor.detection.convergence import Convergence
from vehanchor.records.notices import FLEET_DOUBTS, NoticeCode
from vehanchor.rulers.agreement import disagreements
from vehanchor.rulers.fused import able_rulers, fuse_rulers, shares
from vehanchor.rulers.scene_scale import SceneScale
from vehanchor.scale.fusion import USABLE_CHANCE, fuse, mass_within
from vehanchor.scale.lengths import MIN_KDE_VEHICLES, statistical_log_sds
from vehanchor.scale.thresholds import FALLBACK_CONFIDENCE, GUARD_GSD_M_PER_PX, UNSURE_CONFIDENCE, WIDEST_USABLE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.options.rulers import RulerName
    from vehanchor.records import Reason
    from vehanchor.rulers.evidence import Evidence
    from vehanchor.rulers.fused import FusedScale, RulerShare
    from vehanchor.rulers.vehicles import VehicleEvidence
    from vehanchor.scale.lengths import Interval

_WIDEST_OF_ANY = 3.0  # the same where no chance of being right is known, as with foreign detectors
_LOST_WIDTH = 5.0  # high over low of the scene's own interval: it was never shown the like
_SCENE_REACH, _SCENE_AGREES = 0.4, 0.1  # the ground bears a scale out where it holds a tenth within +-40 %


class ScaleDecision(NamedTuple):
    """The scale that is given out, and how far it may be used.

    Attributes:
        gsd_m_per_px: the vehicles' scale, or, with other rulers that make one, that of all; None without any.
        interval: that holds the true scale in 95 of 100 images; None without a scale.
        p_within_20: chance that the error is below a fifth; None where nobody has fitted how the detector's boxes vote.
        confidence: the paper's of vehicles alone, with other rulers ``p_within_20``; capped where the chance is below
            0.9 or the interval spans more than a factor of 2.
        reason: why the scale is not to be used; None where it is.
        source: kind of the ruler that leads; None without a scale.
        rulers: what each says, and whether it agrees; none without a scale.
    """

    gsd_m_per_px: float | None
    interval: Interval | None
    p_within_20: float | None
    confidence: float
    reason: Reason | None
    source: RulerName | None = None
    rulers: tuple[RulerShare, ...] = ()


def decide(vehicles: VehicleEvidence, others: Sequence[Evidence]) -> ScaleDecision:
    """Judge what the rulers say together.

    Vehicles alone give the paper's scale, judged by the product of their density with that of witnesses; as soon as
    another ruler makes a scale, the scale is that of the product.

    Args:
        vehicles: their evidence.
        others: that of the other rulers.

    Returns:
        The judgement; of vehicles alone without a fitted density their own interval and confidence stand.
    """
    makers = [each for each in able_rulers(others) if each.fusable_density is not None]
    fused = fuse_rulers((vehicles, *others)) if makers else None
    return _of_vehicles(vehicles, others) if fused is None else _of_all(fused, vehicles, others)


def convergence(vehicles: VehicleEvidence, cues: Sequence[Evidence]) -> Convergence:
    """Say of vehicles that were found so far whether more of them would help.

    Args:
        vehicles: their evidence.
        cues: that of what says something of the ground, but makes no scale by itself.

    Returns:
        How far they leave the scale open, and whether it could be used.
    """
    if vehicles.mode_length_px is None:
        return Convergence(math.inf, 0.0, doubted=True)
    scores = vehicles.fleet.scores if vehicles.aggregation == "weighted_kde" else None
    statistical = math.hypot(*statistical_log_sds(vehicles.fleet.lengths, vehicles.mode_length_px, scores=scores))
    doubts = any(notice.code in FLEET_DOUBTS for notice in vehicles.notices)
    return Convergence(
        statistical,
        vehicles.reference.sd_m / vehicles.reference.length_m,
        doubted=doubts or vehicles.guarded or decide(vehicles, cues).reason is not None,
    )


def _of_all(fused: FusedScale, vehicles: VehicleEvidence, others: Sequence[Evidence]) -> ScaleDecision:
    confidence, reason = fused.p_within_20, None
    if fused.p_within_20 < USABLE_CHANCE or fused.interval.high > WIDEST_USABLE * fused.interval.low:
        confidence = min(confidence, UNSURE_CONFIDENCE)
        able = {each.kind for each in able_rulers((vehicles, *others))}
        outvoted = any(not ruler.agrees for ruler in fused.rulers if ruler.kind in able)
        reason = "disagree" if outvoted or disagreements((vehicles, *others)) else "imprecise"
    return ScaleDecision(
        fused.gsd_m_per_px,
        fused.interval,
        fused.p_within_20,
        confidence,
        cast("Reason | None", reason),
        cast("RulerName", fused.leading),
        fused.rulers,
    )


def _of_vehicles(vehicles: VehicleEvidence, others: Sequence[Evidence]) -> ScaleDecision:
    gsd, interval, p_within_20 = vehicles.gsd_m_per_px, vehicles.interval, None
    confidence = vehicles.confidence
    if gsd is not None and vehicles.density is not None:
        densities = [other.density for other in others if other.density is not None]
        interval, p_within_20 = fuse(gsd, vehicles.density, *densities, sharpness=vehicles.sharpness)
        if p_within_20 < USABLE_CHANCE or interval.high > WIDEST_USABLE * interval.low:
            confidence = min(confidence, UNSURE_CONFIDENCE)
    if interval is not None and interval.high > _WIDEST_OF_ANY * interval.low:
        confidence = min(confidence, UNSURE_CONFIDENCE)
    usable = gsd is not None and confidence >= FALLBACK_CONFIDENCE
    return ScaleDecision(
        gsd,
        interval,
        p_within_20,
        confidence,
        None if usable else _reason(vehicles, others),
        None if gsd is None else "vehicles",
        () if gsd is None else shares((vehicles, *(each for each in others if each.density is not None)), gsd),
    )


def _reason(vehicles: VehicleEvidence, others: Sequence[Evidence]) -> Reason:
    """The first of: too few pixels, no cars, rulers that disagree, a scene like no other, too few cars."""
    scene = next((other for other in others if other.kind == SceneScale.kind and other.interval is not None), None)
    lost = scene is not None and scene.interval is not None and scene.interval.high > _LOST_WIDTH * scene.interval.low
    if vehicles.gsd_m_per_px is None:
        coarse = scene is not None and scene.interval is not None and scene.interval.low > GUARD_GSD_M_PER_PX
        return "too_coarse" if coarse else "lost" if lost else "too_few"
    codes = {notice.code for notice in vehicles.notices}
    if vehicles.guarded:
        return "too_coarse"
    contradicted = scene is not None and not _borne_out(vehicles.gsd_m_per_px, scene)
    if NoticeCode.LENGTHS_DISAGREE in codes or contradicted or disagreements((vehicles, *others)):
        return "disagree"
    if codes & set(FLEET_DOUBTS):
        return "not_cars"
    return "lost" if lost and vehicles.n < MIN_KDE_VEHICLES else "too_few"


def _borne_out(gsd_m_per_px: float, scene: Evidence) -> bool:
    return scene.density is None or mass_within(scene.density, gsd_m_per_px, _SCENE_REACH) >= _SCENE_AGREES
