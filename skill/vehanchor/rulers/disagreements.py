"""Warnings of rulers that contradict the answer or each other."""

from __future__ import annotations

import math
from itertools import permutations
from typing import TYPE_CHECKING

from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.registry import ruler_class
from vehanchor.scale.defaults import PROBABLY_RIGHT

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.scale.posterior import Answer, Witness

_STATED = ("known_length", "height")
_UNIT_RATIO, _UNIT_TOLERANCE = math.log(100.0), math.log(2.0)  # centimetres for metres; scenes tell a factor of two


def disagreements(witnesses: Sequence[Witness], found: Answer) -> list[Notice]:
    """Warn of rulers that are probably wrong, and of stated facts whose unit is probably wrong.

    Args:
        witnesses: of all rulers.
        found: their answer.
    """
    heard = [each for each in witnesses if each.found]
    setting = [(each, p) for each, p in zip(heard, found.p_right, strict=True) if each.sets_scale]
    doubted = [each for each, p_right in setting if p_right < PROBABLY_RIGHT]
    if found.reason == "disagree" and not doubted and len(setting) > 1:
        doubted = [each for each, _ in setting]
    notices = [
        Notice(
            code=NoticeCode.RULERS_DISAGREE,
            message=f"{_says(each)} m/px, and all rulers together {found.gsd_m_per_px:.2g}. Check which is wrong "
            "before using either.",
        )
        for each in doubted
        if len(setting) > 1
    ]
    return notices + _unit_notices(heard)


def _unit_notices(heard: Sequence[Witness]) -> list[Notice]:
    """Warn of stated facts that differ from another ruler by a factor of about 100."""
    notices = {}
    for fact, other in permutations(heard, 2):
        if fact.kind not in _STATED or fact.gsd_m_per_px is None or other.gsd_m_per_px is None:
            continue
        off = math.log(fact.gsd_m_per_px / other.gsd_m_per_px)
        if abs(abs(off) - _UNIT_RATIO) <= _UNIT_TOLERANCE:
            message = (
                f"{_says(fact)} m/px, another ruler {other.gsd_m_per_px:.2g}: some 100 times "
                f"{'less' if off > 0 else 'more'}. Its unit is probably wrong: give metres"
                f"{', not centimetres' if off > 0 else ''}."
            )
            notices[fact.kind] = Notice(code=NoticeCode.UNIT_MISTYPED, message=message)
    return list(notices.values())


def _says(witness: Witness) -> str:
    return f"{ruler_class(witness.kind).says().capitalize()} {witness.gsd_m_per_px:.2g}"
