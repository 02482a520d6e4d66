"""Stated facts: lengths and heights from the caller, and their weight beside the rulers of the image.

A measured fact leads unless vehicles or other rulers are confident of a scale that differs by more than
``LEAD_FACTOR``; two measured facts that agree lead at any factor. An assumed fact is a ruler like others: alone it is
usable only if its own chance allows, and against a contradiction only if a second ruler agrees.
"""

from __future__ import annotations

import math
from itertools import combinations
from typing import TYPE_CHECKING, Literal, NamedTuple

from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.agreement import AGREEMENT, agrees
from vehanchor.scale.fusion import USABLE_CHANCE

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from vehanchor.rulers.evidence import Evidence, Fact

LEAD_FACTOR = 1.5
"""Largest ratio to a confident scale at which one measured fact leads."""

MOST_SURE = 0.99
"""Largest chance and confidence of an estimate: no estimate is certain."""

_CONTRADICTED = 0.5  # largest chance of a scale if one claim stands against one
_UNIT_RATIO = 100.0  # centimetres for metres, or the reverse
_UNIT_TOLERANCE = math.log(2.0)  # the scene-scale prior alone is known to a factor of about 1.5


class Verdict(NamedTuple):
    """Limit of a scale by stated facts.

    Attributes:
        chance: largest chance that the scale is right.
        reason: why the scale is not usable; None if the facts allow it.
    """

    chance: float = 1.0
    reason: Literal["assumed", "disagree"] | None = None


def facts(evidence: Iterable[Evidence]) -> list[Fact]:
    """List the stated facts."""
    return [fact for each in evidence for fact in each.facts]


def leading_evidence(evidence: Sequence[Evidence], image_gsd: float | None) -> list[Evidence] | None:
    """Select the evidence to multiply if measured facts lead: theirs, and that of the rulers that agree with them.

    Args:
        evidence: of all rulers.
        image_gsd: scale by the vehicles and all other rulers without facts, if it is usable; None otherwise.

    Returns:
        None without measured facts, or if they contradict each other, a unit or a confident scale of the image.
    """
    measured = [fact for fact in facts(evidence) if fact.basis == "measured"]
    if not measured or not all(_compatible(*pair) for pair in combinations(measured, 2)):
        return None
    if any(fact in measured for fact, _ in _mistyped(evidence)):
        return None
    sets = [each for each in evidence if any(fact.basis == "measured" for fact in each.facts)]
    scale = measured[0].gsd_m_per_px
    if len(measured) == 1 and image_gsd is not None and _ratio(scale, image_gsd) > LEAD_FACTOR:
        return None
    return [each for each in evidence if each in sets or (each.sets_scale and agrees(each, scale))]


def verdict(evidence: Sequence[Evidence], gsd_m_per_px: float, image_gsd: float | None) -> Verdict:
    """Limit a fused scale that no measured fact leads.

    Args:
        evidence: of all rulers.
        gsd_m_per_px: the fused scale.
        image_gsd: scale by the vehicles and all other rulers without facts, if it is usable; None otherwise.
    """
    stated = facts(evidence)
    if not stated:
        return Verdict()
    others = [each for each in evidence if each.sets_scale and not each.facts]
    supporting = [fact for fact in stated if _near(fact, gsd_m_per_px)]
    independent = _independent(supporting)
    supporters = independent + sum(agrees(each, gsd_m_per_px) for each in others)
    measured_aside = any(fact.basis == "measured" and fact not in supporting for fact in stated)
    if measured_aside or _mistyped(evidence):
        return Verdict(_CONTRADICTED, "disagree")
    outvoted = image_gsd is not None and any(not agrees(each, gsd_m_per_px) for each in others)
    contradicted = outvoted or len(supporting) < len(stated)
    far_from_image = image_gsd is not None and _ratio(gsd_m_per_px, image_gsd) > LEAD_FACTOR
    only_facts = supporters == independent
    if contradicted and (supporters < 2 or (only_facts and far_from_image)):
        return Verdict(_CONTRADICTED, "disagree")
    if supporters == independent == 1:
        alone = max(fact.chance for fact in supporting)
        return Verdict(alone, "assumed" if alone < USABLE_CHANCE else None)
    return Verdict()


def unit_notices(evidence: Sequence[Evidence]) -> list[Notice]:
    """Warn of facts that differ from everything else by a factor of about 100."""
    notices = []
    for fact, other in _mistyped(evidence):
        coarser = fact.gsd_m_per_px > other
        message = (
            f"The {fact.name} says {fact.gsd_m_per_px:.2g} m/px, everything else about {other:.2g}: some 100 times "
            f"{'less' if coarser else 'more'}. Its unit is probably wrong: give metres"
            + (", not centimetres." if coarser else ".")
        )
        notices.append(Notice(code=NoticeCode.UNIT_MISTYPED, message=message))
    return notices


def _mistyped(evidence: Sequence[Evidence]) -> list[tuple[Fact, float]]:
    """List facts at some 100 times, or a hundredth, of all other scales, with one of those scales."""
    found = []
    stated = facts(evidence)
    seen = [(each.kind, each.gsd_m_per_px) for each in evidence if not each.facts and each.gsd_m_per_px is not None]
    for fact in stated:
        others = [scale for _, scale in seen] + [each.gsd_m_per_px for each in stated if each is not fact]
        logs = [math.log(fact.gsd_m_per_px / other) for other in others]
        if logs and (all(map(_is_unit, logs)) or all(_is_unit(-log) for log in logs)):
            found.append((fact, others[0]))
    return found


def _independent(supporting: Sequence[Fact]) -> int:
    """Count facts that are not wrong together: those of one family count once."""
    families = {fact.family for fact in supporting if fact.family}
    return len(families) + sum(not fact.family for fact in supporting)


def _is_unit(log_ratio: float) -> bool:
    return abs(log_ratio - math.log(_UNIT_RATIO)) <= _UNIT_TOLERANCE


def _ratio(one: float, other: float) -> float:
    return math.exp(abs(math.log(one / other)))


def _near(fact: Fact, gsd_m_per_px: float) -> bool:
    inside = fact.interval.low <= gsd_m_per_px <= fact.interval.high
    return inside or _ratio(fact.gsd_m_per_px, gsd_m_per_px) <= 1 + AGREEMENT


def _compatible(one: Fact, other: Fact) -> bool:
    return _near(one, other.gsd_m_per_px) or _near(other, one.gsd_m_per_px)
