"""Messages shared by the tools: the rule for planners and parts of answers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.records.text import CHECK_VEHICLES, advice_for, ruler_names, significant
from vehanchor_server.calls.compact import ADVICE_ON_STATED

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from vehanchor.records import AreaMeasurement, DistanceMeasurement, GsdEstimate, Notice
    from vehanchor_server.calls.reply import Detail

POLICY = (
    "Act on the scale only if status is ok: it is right within 20 % in at least 9 of 10 such photographs. "
    "Otherwise use another ruler. no_scale: no ruler was found, gsd_m_per_px is null, never a guess."
)
"""The rule for planners in the description of ``estimate_gsd``."""

_ARGUMENTS = {"known size": "known_lengths", "the region": "region"}
"""Arguments of a remedy, which every measuring tool has."""

STATUS_RULES = (
    "status ok: use it. low_confidence: do not act on it. no_scale: only pixels. Scale arguments: see estimate_gsd."
)
"""The meaning of ``status`` in the descriptions of the measuring tools."""


def rounded(value: float) -> str:
    """Format a number with three significant digits; from 100 without decimals."""
    return significant(value)


def interval(low: float | None, high: float | None) -> str:
    """Format an interval in brackets; empty without one."""
    return "" if low is None or high is None else f" (95 % interval {rounded(low)} to {rounded(high)})"


def ruler_explanations(estimate: GsdEstimate) -> list[str]:
    """Collect the rulers' explanations."""
    return [ruler.explanation for ruler in estimate.rulers if ruler.explanation is not None]


def warnings_of(records: Sequence[AreaMeasurement | DistanceMeasurement], detail: Detail = "full") -> list[str]:
    """Format the warnings of several records once each, with the numbers of the targets that have them."""
    found: dict[Notice, list[int]] = {}
    for number, record in enumerate(records, 1):
        for notice in record.warnings:
            found.setdefault(notice, []).append(number)
    return [
        f"Warning {notice.code}{'' if len(at) == len(records) else f' ({_targets(at)})'}: "
        f"{_shortened(notice.message, detail)}"
        for notice, at in found.items()
    ]


def _targets(numbers: Sequence[int]) -> str:
    return f"target{'' if len(numbers) == 1 else 's'} {', '.join(map(str, numbers))}"


def warnings(notices: Iterable[Notice], detail: Detail = "full") -> list[str]:
    """Format the notices: the first sentence of each, or all with full detail."""
    return [f"Warning {notice.code}: {_shortened(notice.message, detail)}" for notice in notices]


def _shortened(message: str, detail: Detail) -> str:
    first, end, _ = message.partition(". ")
    return first + end.strip() if detail == "short" else message


def numbered(sentences: Sequence[str]) -> str:
    """Return a single sentence unchanged; number several, one per line."""
    if len(sentences) == 1:
        return sentences[0]
    return "\n".join(f"{number}. {sentence}" for number, sentence in enumerate(sentences, 1))


def unusable_scale(estimate: GsdEstimate | None, check: str = CHECK_VEHICLES) -> str:
    """Say why a scale is not usable and what would help; shorter for a stated scale.

    Args:
        estimate: the record of the scale; None for a stated scale.
        check: how the called tool checks the vehicles.
    """
    advice = advice_for(estimate, check)
    if advice is None:
        return f"do not rely on it; {ADVICE_ON_STATED}."
    return f"do not rely on it ({advice.why}); {_with_arguments(advice.helps)}."


def no_scale_message(estimate: GsdEstimate | None) -> str:
    """Say that there is no scale, and what would help."""
    text = "no ruler was found, confidence 0: no metric scale"
    advice = advice_for(estimate)
    return text if advice is None else f"{text} ({advice.why}); {_with_arguments(advice.helps)}"


def _with_arguments(helps: str) -> str:
    named = [argument for words, argument in _ARGUMENTS.items() if words in helps]
    return f"{helps} ({', '.join(named)})" if named else helps


def scale_origin(measured: AreaMeasurement | DistanceMeasurement) -> str:
    """Name the source of a measurement's scale."""
    assert measured.gsd_m_per_px is not None
    scale = f"scale {rounded(measured.gsd_m_per_px)} m/px"
    if measured.estimate is None:
        return f"{scale} as stated, confidence {measured.confidence or 0.0:.2f}"
    return f"{scale}, confidence {measured.confidence:.2f} from {ruler_names(measured.estimate)}"
