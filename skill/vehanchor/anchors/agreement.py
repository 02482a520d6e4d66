"""Whether rulers agree: who says what, where they do not."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

from vehanchor.notices import NoticeCode
from vehanchor.records import Notice

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.anchors.evidence import Evidence

__all__ = ["AGREEMENT", "disagreements"]

AGREEMENT = 0.2  # two scales agree where the larger is at most this share above the smaller
_NAMES = {"vehicles": "the vehicles say", "camera": "the camera's height says", "height": "the given height says"}


def disagreements(evidence: Sequence[Evidence]) -> list[Notice]:
    """Warn of every two rulers whose scales are further apart than a fifth.

    Args:
        evidence: of all rulers. One that found nothing, and a witness, whose confidence is always 0, disagree with
            nobody.

    Returns:
        One notice for each pair.
    """
    found = [each for each in evidence if each.gsd_m_per_px is not None and each.confidence > 0]
    return [
        Notice(
            code=NoticeCode.RULERS_DISAGREE,
            message=f"Two rulers disagree: {_says(one)}, {_says(other)} m/px. Check which of them is wrong before "
            "using either.",
        )
        for one, other in combinations(found, 2)
        if _ratio(one, other) > 1 + AGREEMENT
    ]


def _says(one: Evidence) -> str:
    return f"{_NAMES.get(one.kind, one.kind.replace('_', ' ') + ' says')} {one.gsd_m_per_px:.2g}"


def _ratio(one: Evidence, other: Evidence) -> float:
    low, high = sorted((one.gsd_m_per_px or 0.0, other.gsd_m_per_px or 0.0))
    return high / low
