"""Texts about records: numbers, scales, vehicles, and advice for a scale that is not usable."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from vehanchor.records import FrameScale, GsdEstimate, Reason

NO_SCALE = "no scale: nothing of known size found"


def significant(value: float, digits: int = 3) -> str:
    """Format a finite number with significant digits, such as 0.12 as ``0.120``; 0 is ``0``.

    Trailing zeros stay, because they show the precision. Digits before the point are never
    replaced by zeros: 1234.5 is ``1234``.
    """
    if value == 0:
        return "0"
    # The exponent after rounding counts: 9.996 is shown as 10.0.
    rounded = f"{value:.{digits - 1}e}"
    exponent = int(rounded.partition("e")[2])
    n_decimals = max(digits - 1 - exponent, 0)
    return f"{value:.{n_decimals}f}"


def with_interval(
    value: float | None, low: float | None, high: float | None, unit: str, missing: str = ""
) -> str:
    """Format a quantity with four digits, and with its 95 % interval if it has one.

    Args:
        value: the quantity; None gives ``missing``.
        low: lower end of the interval; None for no interval.
        high: upper end of the interval.
        unit: unit of all three.
        missing: text for a missing quantity.
    """
    if value is None:
        return missing
    text = f"{significant(value, 4)} {unit}"
    if low is not None and high is not None:
        text += f"  (95 %: {significant(low, 4)} to {significant(high, 4)})"
    return text


def count(number: int, noun: str) -> str:
    """Format a number of things, such as "1 vehicle" and "2 vehicles"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def scale_text(record: GsdEstimate | FrameScale) -> str:
    """Format the scale with its interval, or say that there is none."""
    return with_interval(
        record.gsd_m_per_px,
        record.gsd_ci95_low_m_per_px,
        high=record.gsd_ci95_high_m_per_px,
        unit="m/px",
        missing=NO_SCALE,
    )


def by_hand_text(estimate: GsdEstimate) -> str:
    """Count the caller's corrections, such as "by hand: 2 added, 1 dropped"; empty without any."""
    by_hand = estimate.details.by_hand
    if by_hand is None:
        return ""
    parts = []
    if by_hand.added:
        parts.append(f"{by_hand.added} added")
    if by_hand.dropped:
        parts.append(f"{by_hand.dropped} dropped")
    return f"by hand: {', '.join(parts)}" if parts else ""


def ruler_names(estimate: GsdEstimate) -> str:
    """List the rulers that are probably right, the leading one first, without priors."""
    vehicles = count(estimate.n_vehicles or 0, "vehicle")
    names = []
    for ruler in estimate.probable_rulers:
        name = vehicles if ruler.kind == "vehicles" else ruler.label
        names.append(name)
    return " and ".join(names) or vehicles


class Advice(NamedTuple):
    """Advice for a scale that is not usable.

    Attributes:
        why: the problem, a clause without a full stop.
        helps: the remedy, a clause in the imperative.
    """

    why: str
    helps: str


_DRAW_LINE = "draw a line over something of known size"
CHECK_VEHICLES = "check what was taken for cars"
"""Remedy for doubts about vehicles if the caller cannot correct them."""

_CHECK_OR_DRAW_LINE = f"{CHECK_VEHICLES}, or {_DRAW_LINE}"

ADVICE: Mapping[Reason, Advice] = {
    "too_few": Advice("too little evidence", f"include more cars, or {_DRAW_LINE}"),
    "too_coarse": Advice(
        "the vehicles have too little detail", "fly lower, or send the full-resolution image"
    ),
    "no_photograph": Advice(
        "the image is drawn, not photographed", f"send a photograph from above, or {_DRAW_LINE}"
    ),
    "not_cars": Advice("the vehicles may not be cars", _CHECK_OR_DRAW_LINE),
    "disagree": Advice(
        "the evidence contradicts itself", f"check what contradicts it, or {_DRAW_LINE}"
    ),
    "assumed": Advice("it rests on assumed facts alone", f"include cars, or {_DRAW_LINE}"),
    "imprecise": Advice("the interval is too wide", _DRAW_LINE),
}
"""Advice by the ``reason`` alone."""


def advice_for(estimate: GsdEstimate | None, check: str = CHECK_VEHICLES) -> Advice | None:
    """Find the advice for a record by its reason and by what else the record shows.

    Args:
        estimate: the record; None gives no advice.
        check: how the caller checks the vehicles, if the caller can correct them.

    Returns:
        The advice; None for a usable scale.
    """
    if estimate is None or estimate.reason is None:
        return None
    advice = ADVICE[estimate.reason]
    find_cause = _CAUSES.get(estimate.reason)
    if find_cause is not None:
        advice = find_cause(estimate) or advice
    helps = advice.helps.replace(CHECK_VEHICLES, check)
    return advice._replace(helps=helps)


# One function a reason: it looks in the record for the cause of the reason, and returns None if it
# finds none, so that the advice by the reason alone holds.


def _cause_of_too_few(estimate: GsdEstimate) -> Advice | None:
    if estimate.n_vehicles is None:
        return _vehicles_unused("too_few")
    if estimate.n_vehicles == 0:
        return Advice("no car was found", f"{_DRAW_LINE}, or take a picture with cars")
    if not _region_would_help(estimate):
        return None
    vehicles = count(estimate.n_vehicles, "vehicle")
    return Advice(
        f"{vehicles} alone: too little evidence", "give the region, or include one more car"
    )


def _cause_of_imprecise(estimate: GsdEstimate) -> Advice | None:
    if estimate.n_vehicles is None:
        return _vehicles_unused("imprecise")
    if estimate.n_vehicles == 0 or not _region_would_help(estimate):
        return None
    return Advice(ADVICE["imprecise"].why, f"give the region, or {_DRAW_LINE}")


def _vehicles_unused(reason: Reason) -> Advice:
    """Make the advice for a caller who did not choose the ruler vehicles."""
    return Advice(ADVICE[reason].why, f"also use the ruler vehicles, or {_DRAW_LINE}")


def _region_would_help(estimate: GsdEstimate) -> bool:
    """Test whether nobody stated the reference length: a region would make it more precise."""
    return estimate.details.reference_source in ("model", "appearance")


def _cause_of_too_coarse(estimate: GsdEstimate) -> Advice | None:
    if not estimate.n_vehicles:
        return Advice(
            "no car was found, and the scene looks too coarse for cars",
            f"send the full-resolution image, or {_DRAW_LINE}",
        )
    if _warns(estimate, "detail_missing"):
        return Advice("the image is enlarged or blurred", "send the original image")
    if estimate.mode_length_px is None:
        return None
    return Advice(
        f"the vehicles are only {estimate.mode_length_px:.0f} px long", ADVICE["too_coarse"].helps
    )


def _cause_of_disagreement(estimate: GsdEstimate) -> Advice | None:
    if _warns(estimate, "tilt_suspected"):
        return Advice(
            "the camera was tilted by an unknown angle",
            "send the original file, or a picture taken straight down",
        )
    if _warns(estimate, "stretched"):
        return Advice(
            "the image is stretched in one direction",
            "send the original image, or keep its aspect ratio",
        )
    labels = [ruler.label for ruler in estimate.rulers if ruler.sets_scale]
    if len(labels) > 1:
        rulers = " and ".join(labels)
        return Advice(f"{rulers} contradict each other", f"check them, or {_DRAW_LINE}")
    # If only one ruler sets the scale, the scene-scale prior is what contradicts it.
    scene = estimate.details.scene_scale
    if scene is None or not estimate.n_vehicles:
        return None
    return Advice(
        f"the scene suggests a scale of about {scene.gsd_m_per_px:.2g} m/px", _CHECK_OR_DRAW_LINE
    )


def _warns(estimate: GsdEstimate, code: str) -> bool:
    return any(notice.code == code for notice in estimate.warnings)


_CAUSES: Mapping[Reason, Callable[[GsdEstimate], Advice | None]] = {
    "too_few": _cause_of_too_few,
    "too_coarse": _cause_of_too_coarse,
    "disagree": _cause_of_disagreement,
    "imprecise": _cause_of_imprecise,
}
