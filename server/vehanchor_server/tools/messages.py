"""Messages shared by the tools: the rule for planners and parts of answers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.records import GsdEstimate
from vehanchor.records.text import advice_for, ruler_names, significant
from vehanchor_server.calls.compact import brief
from vehanchor_server.calls.remedies import advice_on

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.records import AreaMeasurement, DistanceMeasurement, Notice
    from vehanchor_server.calls.reply import Detail

POLICY = (
    "Act on the scale only if status is ok: it is right within 20 % in at least 9 of 10 such photographs. "
    "Otherwise use another ruler. no_scale: no ruler was found, gsd_m_per_px is null, never a guess."
)
"""The rule for planners in the description of ``estimate_gsd``."""

STATUS_RULES = (
    "status ok: use it, but compare the interval's low end with what you need. low_confidence: do not act on it. "
    "no_scale: only pixels. Scale arguments: see estimate_gsd."
)
"""The meaning of ``status`` in the descriptions of the measuring tools."""


def interval(low: float | None, high: float | None) -> str:
    """Format an interval in brackets; empty without one."""
    return "" if low is None or high is None else f" (95 % interval {significant(low)} to {significant(high)})"


def warnings_of(records: Sequence[GsdEstimate | AreaMeasurement | DistanceMeasurement], detail: Detail) -> list[str]:
    """Format the warnings of records once each, with the numbers of the targets that have them.

    Args:
        records: of one image.
        detail: full for all sentences of each, short for the first.
    """
    found: dict[Notice, list[int]] = {}
    for number, record in enumerate(records, 1):
        for notice in record.warnings:
            found.setdefault(notice, []).append(number)
    return [
        f"Warning {notice.code}{'' if len(at) == len(records) else f' ({_targets(at)})'}: "
        f"{brief(notice.message) if detail == 'short' else notice.message}"
        for notice, at in found.items()
    ]


def _targets(numbers: Sequence[int]) -> str:
    return f"target{'' if len(numbers) == 1 else 's'} {', '.join(map(str, numbers))}"


def verdict(record: GsdEstimate | AreaMeasurement | DistanceMeasurement) -> str:
    """Say whether a record is usable; if not, say why and what would help."""
    if record.status == "ok":
        return "safe to use."
    return f"do not rely on it{_why(record)}; {advice_on(record)}."


def no_scale(record: GsdEstimate | AreaMeasurement | DistanceMeasurement) -> str:
    """Say that there is no scale, why, and what would help."""
    return f"no ruler was found, confidence 0: no metric scale{_why(record)}; {advice_on(record)}."


def _why(record: GsdEstimate | AreaMeasurement | DistanceMeasurement) -> str:
    """Give the reason against a scale in brackets; empty without one."""
    advice = advice_for(record if isinstance(record, GsdEstimate) else record.estimate)
    return "" if advice is None else f" ({advice.why})"


def scale_origin(measured: AreaMeasurement | DistanceMeasurement) -> str:
    """Name the source of a measurement's scale."""
    assert measured.gsd_m_per_px is not None
    source = "as stated" if measured.estimate is None else f"from {ruler_names(measured.estimate)}"
    return (
        f"scale {significant(measured.gsd_m_per_px)} m/px {source}, scale confidence {measured.confidence or 0.0:.2f}"
    )
