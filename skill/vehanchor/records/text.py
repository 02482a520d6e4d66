"""Text from records: numbers, scales, vehicles, and advice for a scale that is not usable."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Mapping

    from vehanchor.records import FrameScale, GsdEstimate, Reason

NO_SCALE = "no scale: nothing of known size found"


def significant(value: float, digits: int = 3) -> str:
    """Format a finite number with significant digits: 0.12 as ``0.120``, 1234.5 as ``1234``; 0 as ``0``.

    Zeros are kept, because they say how exactly the number is known. Whole digits are never
    replaced by zeros.
    """
    if value == 0:
        return "0"
    # after rounding: 9.996 has that of 10.0
    exponent = int(f"{value:.{digits - 1}e}".partition("e")[2])
    return f"{value:.{max(digits - 1 - exponent, 0)}f}"


def with_interval(
    value: float | None, low: float | None, high: float | None, unit: str, missing: str = ""
) -> str:
    """Format a quantity with four digits, and with its 95 % interval if it has one; ``missing`` without a value."""
    if value is None:
        return missing
    interval = (
        ""
        if low is None or high is None
        else f"  (95 %: {significant(low, 4)} to {significant(high, 4)})"
    )
    return f"{significant(value, 4)} {unit}{interval}"


def count(number: int, noun: str) -> str:
    """Format a number of things, as "1 vehicle" and "2 vehicles"."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def scale_text(of: GsdEstimate | FrameScale) -> str:
    """Format the scale with its interval, or say that there is none."""
    return with_interval(
        of.gsd_m_per_px,
        of.gsd_ci95_low_m_per_px,
        high=of.gsd_ci95_high_m_per_px,
        unit="m/px",
        missing=NO_SCALE,
    )


def by_hand_text(estimate: GsdEstimate) -> str:
    """Count the caller's corrections, as "by hand: 2 added, 1 dropped"; empty without any."""
    told = estimate.details.by_hand
    counts = {} if told is None else {"added": told.added, "dropped": told.dropped}
    listed = ", ".join(f"{n} {each}" for each, n in counts.items() if n)
    return listed and f"by hand: {listed}"


def ruler_names(estimate: GsdEstimate) -> str:
    """List the rulers that are probably right, the leading one first, without priors."""
    cars = count(estimate.n_vehicles or 0, "vehicle")
    words = [
        cars if ruler.kind == "vehicles" else ruler.label for ruler in estimate.probable_rulers
    ]
    return " and ".join(words) or cars


class Advice(NamedTuple):
    """Advice for a scale that is not usable.

    Attributes:
        why: the problem, a clause without a full stop.
        helps: the remedy, a clause in the imperative.
    """

    why: str
    helps: str


_LINE = "draw a line over something of known size"
CHECK_VEHICLES = "check what was taken for cars"
"""Remedy for doubts about vehicles where the caller cannot correct them."""

_CHECK = f"{CHECK_VEHICLES}, or {_LINE}"

ADVICE: Mapping[Reason, Advice] = {
    "too_few": Advice("too little evidence", f"include more cars, or {_LINE}"),
    "too_coarse": Advice(
        "the vehicles have too little detail", "fly lower, or send the full-resolution image"
    ),
    "not_cars": Advice("the vehicles may not be cars", _CHECK),
    "disagree": Advice("the evidence contradicts itself", f"check what contradicts it, or {_LINE}"),
    "assumed": Advice("it rests on assumed facts alone", f"include cars, or {_LINE}"),
    "imprecise": Advice("the interval is too wide", _LINE),
}
"""Advice by the ``reason`` alone, for a summary of several records."""


def advice_for(estimate: GsdEstimate | None, check: str = CHECK_VEHICLES) -> Advice | None:
    """Give the advice for a record by its reason and by what it shows; None without one and for a usable scale.

    Args:
        estimate: the record.
        check: how the caller checks the vehicles, if they can be corrected.
    """
    if estimate is None or estimate.reason is None:
        return None
    advice = _specific(estimate) or ADVICE[estimate.reason]
    return advice._replace(helps=advice.helps.replace(CHECK_VEHICLES, check))


def _specific(estimate: GsdEstimate) -> Advice | None:
    """Give the advice for a cause that the record shows; None for that of the reason alone."""
    reason = estimate.reason
    n = estimate.n_vehicles or 0
    codes = {notice.code for notice in estimate.warnings}
    if reason in ("too_few", "imprecise") and estimate.n_vehicles is None:
        return Advice(ADVICE[reason].why, f"also use the ruler vehicles, or {_LINE}")
    if n == 0 and reason == "too_few":
        return Advice("no car was found", f"{_LINE}, or take a picture with cars")
    if n == 0 and reason == "too_coarse":
        return Advice(
            "no car was found, and the scene looks too coarse for cars",
            f"send the full-resolution image, or {_LINE}",
        )
    if "detail_missing" in codes and reason == "too_coarse":
        return Advice("the image is enlarged or blurred", "send the original image")
    if reason == "too_coarse" and estimate.mode_length_px is not None:
        return Advice(
            f"the vehicles are only {estimate.mode_length_px:.0f} px long",
            ADVICE["too_coarse"].helps,
        )
    if "tilt_suspected" in codes and reason == "disagree":
        return Advice(
            "the camera was tilted by an unknown angle",
            "send the original file, or a picture taken straight down",
        )
    if "stretched" in codes and reason == "disagree":
        return Advice(
            "the image is stretched in one direction",
            "send the original image, or keep its aspect ratio",
        )
    if reason == "disagree":
        return _disagreement(estimate)
    if (
        reason in ("too_few", "imprecise")
        and n
        and estimate.details.reference_source in ("model", "appearance")
    ):
        if reason == "imprecise":
            return Advice(ADVICE[reason].why, f"give the region, or {_LINE}")
        alone = f"{count(n, 'vehicle')} alone: too little evidence"
        return Advice(alone, "give the region, or include one more car")
    return None


def _disagreement(estimate: GsdEstimate) -> Advice | None:
    """Name the rulers that contradict each other, or the scene that contradicts the only one."""
    setting = [ruler.label for ruler in estimate.rulers if ruler.sets_scale]
    if len(setting) > 1:
        return Advice(f"{' and '.join(setting)} contradict each other", f"check them, or {_LINE}")
    scene = estimate.details.scene_scale
    if scene is not None and estimate.n_vehicles:
        return Advice(f"by the scene the scale is about {scene.gsd_m_per_px:.2g} m/px", _CHECK)
    return None
