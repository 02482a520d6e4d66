"""Words that tools share: the rule that planners are told, and the pieces of answers."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from vehanchor.records import GsdEstimate, Notice

__all__ = ["POLICY", "interval", "rounded", "scale_doubt", "vehicles", "warnings"]

POLICY = (
    "Rule for planners: use the scale where confidence >= 0.5. Below 0.5 do not act on it: fall back to another anchor "
    "(known altitude, visual odometry, an object of known size). Confidence 0 means that no vehicle was found and "
    "there is no estimate: gsd_m_per_px is null, never a guess."
)


def rounded(value: float) -> str:
    """Three digits, or all before the point."""
    return f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"


def interval(low: float | None, high: float | None) -> str:
    """The interval in brackets; nothing without one."""
    return "" if low is None or high is None else f" (95 % interval {rounded(low)} to {rounded(high)})"


def vehicles(number: int) -> str:
    """So many vehicles."""
    return f"{number} vehicle{'' if number == 1 else 's'}"


def warnings(notices: Iterable[Notice]) -> list[str]:
    """One sentence for each notice."""
    return [f"Warning {notice.code}: {notice.message}" for notice in notices]


def scale_doubt(estimate: GsdEstimate) -> str:
    """The reason why a scale's confidence is low."""
    from vehanchor.notices import FLEET_DOUBTS

    if estimate.resolution_guard:
        return "vehicles show too little detail to be measured well"
    if any(notice.code in FLEET_DOUBTS for notice in estimate.warnings):
        return "the vehicles may not be cars"
    return "too little evidence"
