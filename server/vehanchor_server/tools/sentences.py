"""Words that tools share: the rule that planners are told, and the pieces of answers."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.advice import ADVICE

if TYPE_CHECKING:
    from collections.abc import Iterable

    from vehanchor.records import GsdEstimate, Notice

__all__ = ["POLICY", "interval", "not_to_be_used", "rounded", "sources", "vehicles", "warnings", "what_rulers_say"]

POLICY = (
    "Rule for planners: use the scale where confidence >= 0.5. Below 0.5 do not act on it: fall back to another anchor "
    "(known altitude, visual odometry, an object of known size). Confidence 0 means that no vehicle and no other ruler "
    "was found and there is no estimate: gsd_m_per_px is null, never a guess."
)
_RULERS = {
    "scene_scale": "the look of the ground",
    "camera": "the camera's metadata",
    "known_length": "known length",
    "height": "the given height",
    "courts": "sports courts",
}


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
    """What a scale was measured by: the rulers that agree with it, the one that leads first; a witness is left out."""
    agreeing = [ruler for ruler in estimate.rulers if ruler.agrees and ruler.kind != "scene_scale"]
    names = {"vehicles": vehicles(estimate.n_vehicles), **_RULERS}
    by_weight = sorted(agreeing, key=lambda ruler: -ruler.weight)
    words = [names.get(ruler.kind, ruler.kind.replace("_", " ")) for ruler in by_weight]
    return " and ".join(words) or vehicles(estimate.n_vehicles)


def what_rulers_say(estimate: GsdEstimate) -> list[str]:
    """One sentence for each ruler that has one."""
    return [ruler.says for ruler in estimate.rulers if ruler.says is not None]


def warnings(notices: Iterable[Notice]) -> list[str]:
    """One sentence for each notice."""
    return [f"Warning {notice.code}: {notice.message}" for notice in notices]


def not_to_be_used(estimate: GsdEstimate) -> str:
    """Why a scale is not to be used and what would help; nothing where it may be."""
    if estimate.reason is None:
        return ""
    why, helps = ADVICE[estimate.reason]
    return f"do not rely on it ({why}); {helps}, or fall back to another anchor."
