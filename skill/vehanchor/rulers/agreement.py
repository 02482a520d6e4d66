"""Whether rulers agree: who says what, where they do not."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from vehanchor.rulers.evidence import Evidence

AGREEMENT = 0.2  # two scales agree where the larger is at most this share above the smaller
_NAMES = {
    "vehicles": "the vehicles say",
    "camera": "the camera's height says",
    "known_length": "the known length says",
    "height": "the given height says",
    "courts": "the courts say",
    "positions": "the positions say",
}
_CHECK = "Check which of them is wrong before using either."


def disagreements(evidence: Sequence[Evidence], outvoted: Collection[str] = ()) -> list[Notice]:
    """Warn of rulers that are outvoted, and of every two others whose scales are further apart than a fifth.

    Args:
        evidence: of all rulers. One that found nothing, and a witness, whose confidence is always 0, disagree with
            nobody.
        outvoted: kinds of those that do not agree with the scale of all.

    Returns:
        One notice for each outvoted ruler, one for each other pair.
    """
    found = [each for each in evidence if each.gsd_m_per_px is not None and each.confidence > 0]
    kept = [each for each in found if each.kind not in outvoted] or found
    notices = []
    for liar in (each for each in found if each not in kept):
        if len(kept) == 1:
            notices.append(_pair(*sorted((liar, kept[0]), key=found.index)))
        elif kept:
            others = ", ".join(map(_says, kept))
            message = f"{_says(liar).capitalize()} m/px, and the other rulers disagree: {others} m/px. {_CHECK}"
            notices.append(Notice(code=NoticeCode.RULERS_DISAGREE, message=message))
    return notices + [_pair(*pair) for pair in combinations(kept, 2) if _ratio(*pair) > 1 + AGREEMENT]


def _pair(one: Evidence, other: Evidence) -> Notice:
    return Notice(
        code=NoticeCode.RULERS_DISAGREE,
        message=f"Two rulers disagree: {_says(one)}, {_says(other)} m/px. {_CHECK}",
    )


def _says(one: Evidence) -> str:
    return f"{_NAMES.get(one.kind, one.kind.replace('_', ' ') + ' says')} {one.gsd_m_per_px:.2g}"


def _ratio(one: Evidence, other: Evidence) -> float:
    low, high = sorted((one.gsd_m_per_px or 0.0, other.gsd_m_per_px or 0.0))
    return high / low
