"""Contradiction between what a file or a caller states and what the image shows, in words."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from vehanchor.records.gsd_estimate import GsdEstimate
from vehanchor.records.notices import NoticeCode
from vehanchor.records.text import significant

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vehanchor.records import AreaMeasurement, DistanceMeasurement, RulerScale

# Kinds of the rulers that rest on a statement, and what helps if the image contradicts it.
_CHECKS = {
    "camera": "check its height and lens, or leave out the file's metadata",
    "known_length": "measure it again, or leave it out",
    "height": "check it and the lens, or leave it out",
    "stated_scale": "check it, or leave it out",
}


class Contradiction(NamedTuple):
    """Two scales of one image that exclude each other.

    Attributes:
        code: code of the notice that warns of it.
        text: both scales, a sentence without a full stop.
        premise: condition under which a usable scale holds, beginning with "if"; empty if the
            scale is that of the statement.
    """

    code: NoticeCode
    text: str
    premise: str = ""


def contradiction_of(
    record: GsdEstimate | AreaMeasurement | DistanceMeasurement,
) -> Contradiction | None:
    """Find the contradiction that a reader must know before the result; None without one."""
    for notice in record.warnings:
        if notice.code == NoticeCode.GEOREFERENCE_DIFFERS:
            both_scales = notice.message.partition(". ")[0]
            premise = "if the file's georeference is wrong, as in a resized copy"
            return Contradiction(NoticeCode.GEOREFERENCE_DIFFERS, both_scales, premise)
    estimate = record if isinstance(record, GsdEstimate) else record.estimate
    return None if estimate is None else _of_rulers(estimate)


def contradiction_text(record: GsdEstimate | AreaMeasurement | DistanceMeasurement) -> str:
    """State both scales of a contradiction; empty without one."""
    contradiction = contradiction_of(record)
    return "" if contradiction is None else contradiction.text


def _of_rulers(estimate: GsdEstimate) -> Contradiction | None:
    """Find a statement whose interval does not meet that of another ruler."""
    if not any(notice.code == NoticeCode.RULERS_DISAGREE for notice in estimate.warnings):
        return None
    for statement, other in _pairs(estimate):
        if _intervals_meet(statement, other):
            continue
        name = statement.label
        if statement.kind == "camera":
            name = "camera in the file"
        text = (
            f"The {name} gives {significant(statement.gsd_m_per_px)} m/px, "
            f"the {other.label} {significant(other.gsd_m_per_px)} m/px"
        )
        premise = ""
        if not statement.probably_right:
            premise = f"if the {name} is wrong: {_CHECKS[statement.kind]}"
        return Contradiction(NoticeCode.RULERS_DISAGREE, text, premise)
    return None


def _pairs(estimate: GsdEstimate) -> Iterator[tuple[RulerScale, RulerScale]]:
    """Pair each ruler that rests on a statement with each other one that sets the scale.

    Those that measure the image come first.
    """
    setting = [ruler for ruler in estimate.rulers if ruler.sets_scale]
    statements = [ruler for ruler in setting if ruler.kind in _CHECKS]
    seen = [ruler for ruler in setting if ruler.kind not in _CHECKS]
    for statement in statements:
        for other in (*seen, *statements):
            if other is not statement:
                yield statement, other


def _intervals_meet(first: RulerScale, second: RulerScale) -> bool:
    """Test whether the 95 % intervals of two rulers have a common scale."""
    low = max(first.gsd_ci95_low_m_per_px, second.gsd_ci95_low_m_per_px)
    high = min(first.gsd_ci95_high_m_per_px, second.gsd_ci95_high_m_per_px)
    return low <= high
