"""Agreement of rulers.

A ruler agrees with a scale in its 95 % interval, or within a tenth of its own scale. Two rulers agree if their
intervals overlap, or if one agrees with the other's scale.
"""

from __future__ import annotations

import math
from itertools import combinations
from typing import TYPE_CHECKING

from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.registry import ruler_class

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from vehanchor.rulers.evidence import Evidence

AGREEMENT = 0.1
_CHECK = "Check which of them is wrong before using either."
_SETTLED = "The measured fact leads."


def agrees(ruler: Evidence, gsd_m_per_px: float) -> bool:
    """Tell whether a ruler agrees with a scale."""
    if ruler.gsd_m_per_px is None or ruler.interval is None:
        return False
    in_interval = ruler.interval.low <= gsd_m_per_px <= ruler.interval.high
    return in_interval or abs(math.log(ruler.gsd_m_per_px / gsd_m_per_px)) <= math.log1p(AGREEMENT)


def disagreements(
    evidence: Sequence[Evidence], outvoted: Collection[str] = (), *, settled: bool = False
) -> list[Notice]:
    """Warn of outvoted rulers, and of other pairs that disagree.

    Args:
        evidence: of all rulers. Rulers without evidence and priors never disagree.
        outvoted: kinds of the rulers that disagree with the fused scale.
        settled: whether measured facts decide which of them is wrong.

    Returns:
        One notice per outvoted ruler, and one per other pair.
    """
    found = [each for each in evidence if each.sets_scale]
    kept = [each for each in found if each.kind not in outvoted] or found
    remedy = _SETTLED if settled else _CHECK
    notices = []
    for wrong in (each for each in found if each not in kept):
        if len(kept) == 1:
            notices.append(_pair(*sorted((wrong, kept[0]), key=found.index), remedy=remedy))
        else:
            others = ", ".join(map(_says, kept))
            message = f"{_says(wrong).capitalize()} m/px, and the other rulers disagree: {others} m/px. {remedy}"
            notices.append(Notice(code=NoticeCode.RULERS_DISAGREE, message=message))
    return notices + [_pair(*pair, remedy=remedy) for pair in combinations(kept, 2) if not _compatible(*pair)]


def outvoted_priors(evidence: Sequence[Evidence]) -> dict[str, Notice]:
    """Find priors that contradict rulers which agree with each other.

    Args:
        evidence: of all rulers.

    Returns:
        A notice by kind of prior. Two or more rulers that set a scale agree, and the prior agrees with none of them.
    """
    able = [each for each in evidence if each.sets_scale]
    agreeing = {each.kind: each for pair in combinations(able, 2) if _compatible(*pair) for each in pair}
    priors = [each for each in evidence if not each.sets_scale and each.gsd_m_per_px is not None]
    found = {}
    for prior in priors if agreeing else ():
        if not any(agrees(prior, each.gsd_m_per_px) for each in agreeing.values() if each.gsd_m_per_px):
            others = ", ".join(map(_says, agreeing.values()))
            message = f"{_says(prior).capitalize()} m/px. It is left out, because other rulers agree: {others} m/px."
            found[prior.kind] = Notice(code=NoticeCode.RULERS_DISAGREE, message=message)
    return found


def _compatible(one: Evidence, other: Evidence) -> bool:
    assert one.gsd_m_per_px is not None
    assert other.gsd_m_per_px is not None
    if agrees(one, other.gsd_m_per_px) or agrees(other, one.gsd_m_per_px):
        return True
    if one.interval is None or other.interval is None:
        return False
    return one.interval.low <= other.interval.high and other.interval.low <= one.interval.high


def _pair(one: Evidence, other: Evidence, *, remedy: str) -> Notice:
    return Notice(
        code=NoticeCode.RULERS_DISAGREE,
        message=f"Two rulers disagree: {_says(one)}, {_says(other)} m/px. {remedy}",
    )


def _says(one: Evidence) -> str:
    return f"{ruler_class(one.kind).says()} {one.gsd_m_per_px:.2g}"
