"""Advice for a scale that is not usable: the problem and a remedy, by the reason and by what was seen."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from vehanchor.records import GsdEstimate, Reason


class Advice(NamedTuple):
    """Advice for a scale that is not usable.

    Attributes:
        why: the problem, a clause without a full stop.
        helps: the remedy, a clause in the imperative.
    """

    why: str
    helps: str


_KNOWN = "give a known length or the camera's height"
CHECK_VEHICLES = "check what was taken for cars"
"""Remedy for doubts about vehicles where the caller cannot correct them."""

_CHECK = f"{CHECK_VEHICLES}, or {_KNOWN}"

ADVICE: Mapping[Reason, Advice] = {
    "too_coarse": Advice("the vehicles have too little detail", "fly lower, or send the full-resolution image"),
    "too_few": Advice("too little evidence", f"{_KNOWN}, or include more cars"),
    "not_cars": Advice("the vehicles may not be cars", _CHECK),
    "stretched": Advice("the image is stretched in one direction", "send the original image, or keep its aspect ratio"),
    "disagree": Advice("sizes or rulers contradict each other", _CHECK),
    "lost": Advice("the scene is unlike the training data", _KNOWN),
    "imprecise": Advice("the interval is too wide", f"{_KNOWN}, or include cars"),
    "assumed": Advice("it rests on one assumed fact", "say that it is measured, if it is, or give a second fact"),
}
"""Advice by the ``reason`` alone, for a summary of several records."""


class _Case(NamedTuple):
    """Row of the table: advice for a reason if the record shows a cause.

    Attributes:
        reason: of the record.
        shown: whether the record shows the cause.
        advice: its texts may name fields of ``_facts``.
    """

    reason: Reason
    shown: Callable[[GsdEstimate], bool]
    advice: Advice


def _searched(estimate: GsdEstimate) -> bool:
    return estimate.stopped_because is not None or estimate.n_detections > 0


def _has(code: str) -> Callable[[GsdEstimate], bool]:
    return lambda estimate: any(notice.code == code for notice in estimate.warnings)


def _without_vehicles(estimate: GsdEstimate) -> bool:
    return estimate.n_vehicles == 0


def _finer_scene(estimate: GsdEstimate) -> bool:
    """Return whether the scene looks finer than the vehicles' scale."""
    scene, low = estimate.scene_scale, estimate.gsd_ci95_low_m_per_px
    return scene is not None and low is not None and scene.gsd_ci95_high_m_per_px < low


def _scene_apart(estimate: GsdEstimate) -> bool:
    scene, gsd = estimate.scene_scale, estimate.gsd_m_per_px
    return scene is not None and gsd is not None and not _within(scene.gsd_m_per_px, gsd)


def _within(scene_gsd: float, gsd: float) -> bool:
    return gsd / _APART < scene_gsd < gsd * _APART


def _rulers_apart(estimate: GsdEstimate) -> bool:
    setting = [ruler for ruler in estimate.rulers if ruler.sets_scale]
    return len(setting) > 1 and not all(ruler.agrees for ruler in setting)


_APART = 1.4
_WITHOUT_SEARCH = Advice("too little evidence", "also use the ruler vehicles, or give a known length or the height")
_NO_CAR = Advice("no car was found", f"{_KNOWN}, or take a picture with cars")

_CASES: tuple[_Case, ...] = (
    _Case("too_coarse", _has("detail_missing"), Advice("the image is enlarged or blurred", "send the original image")),
    _Case(
        "too_coarse",
        _without_vehicles,
        Advice(
            "no car was found, and the scene looks too coarse for cars", f"send the full-resolution image, or {_KNOWN}"
        ),
    ),
    _Case("too_coarse", _finer_scene, Advice("what was found is too small for cars in this scene", _CHECK)),
    _Case(
        "too_coarse",
        lambda estimate: estimate.mode_length_px is not None,
        Advice("the vehicles are only {length} px long", ADVICE["too_coarse"].helps),
    ),
    _Case("too_few", lambda estimate: not _searched(estimate), _WITHOUT_SEARCH),
    _Case("too_few", _without_vehicles, _NO_CAR),
    _Case("too_few", lambda _: True, Advice("{vehicles} alone: too little evidence", ADVICE["too_few"].helps)),
    _Case("lost", _without_vehicles, Advice("no car was found, and the scene does not tell its scale", _KNOWN)),
    _Case("lost", lambda _: True, Advice("{vehicles} alone, and the scene does not tell its scale", _KNOWN)),
    _Case("disagree", _rulers_apart, Advice("{rulers} contradict each other", f"check them, or {_KNOWN}")),
    _Case("disagree", _has("lengths_disagree"), Advice("the vehicles have two sizes", _CHECK)),
    _Case("disagree", _scene_apart, Advice("by the scene the scale is about {scene} m/px", _CHECK)),
    _Case(
        "imprecise",
        lambda estimate: not _searched(estimate),
        Advice(ADVICE["imprecise"].why, _WITHOUT_SEARCH.helps),
    ),
    _Case("imprecise", lambda estimate: not _without_vehicles(estimate), Advice(ADVICE["imprecise"].why, _KNOWN)),
)
"""Decision table: the first row of the reason whose cause the record shows."""


def advice_for(estimate: GsdEstimate | None, check: str = CHECK_VEHICLES) -> Advice | None:
    """Give the advice for a record by what it shows; None without one and for a usable scale.

    Args:
        estimate: the record.
        check: how the caller checks the vehicles, if they can be corrected.
    """
    if estimate is None or estimate.reason is None:
        return None
    fitting = (case.advice for case in _CASES if case.reason == estimate.reason and case.shown(estimate))
    advice = next(fitting, ADVICE[estimate.reason])
    facts = _facts(estimate)
    return Advice(advice.why.format(**facts), advice.helps.format(**facts).replace(CHECK_VEHICLES, check))


def _facts(estimate: GsdEstimate) -> dict[str, str]:
    """Return what the texts of the table name."""
    number, scene = estimate.n_vehicles, estimate.scene_scale
    return {
        "vehicles": f"{number} vehicle{'' if number == 1 else 's'}",
        "rulers": " and ".join(ruler.label for ruler in estimate.rulers if ruler.sets_scale),
        "length": "" if estimate.mode_length_px is None else f"{estimate.mode_length_px:.0f}",
        "scene": "" if scene is None else f"{scene.gsd_m_per_px:.2g}",
    }
