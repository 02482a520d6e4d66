"""Words that tools share: the rule that planners are told, and the pieces of answers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.records.advice import ADVICE

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from vehanchor.records import AreaMeasurement, DistanceMeasurement, GsdEstimate, Notice
    from vehanchor_server.calls.answer import Detail

POLICY = (
    "Rule for planners: use the scale where confidence >= 0.5. Below 0.5 do not act on it: fall back to another anchor "
    "(known altitude, visual odometry, an object of known size). Confidence 0 means that no vehicle and no other ruler "
    "was found and there is no estimate: gsd_m_per_px is null, never a guess."
)
"""Said once, by the tool that measures the scale."""

OBEY = (
    "status ok: use it. low_confidence: do not act on it. no_scale: no metres, only pixels. Give the scale of an "
    "earlier answer about this image back, and nothing is searched again."
)
"""What the tools that use a scale say of it."""


def rounded(value: float) -> str:
    """Three digits, or all before the point."""
    return f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"


def interval(low: float | None, high: float | None) -> str:
    """The interval in brackets; nothing without one."""
    return "" if low is None or high is None else f" (95 % interval {rounded(low)} to {rounded(high)})"


def vehicles(number: int) -> str:
    """So many vehicles."""
    return f"{number} vehicle{'' if number == 1 else 's'}"


def sources(estimate: GsdEstimate) -> str:
    """The rulers that agree with a scale, the one of the largest weight first; priors are left out."""
    agreeing = [ruler for ruler in estimate.rulers if ruler.agrees and ruler.sets_scale]
    by_weight = sorted(agreeing, key=lambda ruler: -ruler.weight)
    words = [vehicles(estimate.n_vehicles) if ruler.kind == "vehicles" else ruler.label for ruler in by_weight]
    return " and ".join(words) or vehicles(estimate.n_vehicles)


def what_rulers_say(estimate: GsdEstimate) -> list[str]:
    """One sentence for each ruler that has one."""
    return [ruler.explanation for ruler in estimate.rulers if ruler.explanation is not None]


def warnings(notices: Iterable[Notice], detail: Detail = "full") -> list[str]:
    """Each notice in a sentence, or in all of its own."""
    return [f"Warning {notice.code}: {_said(notice.message, detail)}" for notice in notices]


def _said(message: str, detail: Detail) -> str:
    first, end, _ = message.partition(". ")
    return first + end.strip() if detail == "short" else message


def numbered(sentences: Sequence[str]) -> str:
    """One sentence, or a numbered line for each."""
    if len(sentences) == 1:
        return sentences[0]
    return "\n".join(f"{number}. {sentence}" for number, sentence in enumerate(sentences, 1))


def not_to_be_used(estimate: GsdEstimate | None) -> str:
    """Why a scale is not to be used and what would help; shorter where the scale was given back."""
    if estimate is None or estimate.reason is None:
        return "do not rely on it; fall back to another anchor."
    why, helps = ADVICE[estimate.reason]
    return f"do not rely on it ({why}); {helps}, or fall back to another anchor."


def nothing_found(estimate: GsdEstimate | None) -> str:
    """That there is no scale, and what would help."""
    said = "nothing of known size was found, confidence 0: no metric scale"
    if estimate is None or estimate.reason is None:
        return f"{said}; use another anchor"
    return f"{said}; {ADVICE[estimate.reason].helps}, or use another anchor"


def scale_origin(measured: AreaMeasurement | DistanceMeasurement) -> str:
    """Where the scale of a measurement comes from."""
    assert measured.gsd_m_per_px is not None
    scale = f"scale {rounded(measured.gsd_m_per_px)} m/px"
    if measured.confidence is None:
        return f"{scale} as given"
    if measured.estimate is None:
        return f"{scale} given back, confidence {measured.confidence:.2f}"
    return f"{scale}, confidence {measured.confidence:.2f} from {sources(measured.estimate)}"
