"""Texts about records: numbers, scales and vehicles."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Protocol

from vehanchor.records.gsd_estimate import GsdEstimate
from vehanchor.scale.defaults import INTERVAL_PREMISE

if TYPE_CHECKING:
    from vehanchor.records import AreaMeasurement, DistanceMeasurement
    from vehanchor.records.measurement import Fit

NO_SCALE = "no scale: nothing of known size found"


class Scale(Protocol):
    """A record that states a scale and its interval; None without a scale."""

    @property
    def gsd_m_per_px(self) -> float | None:
        """The scale, in metres per pixel."""

    @property
    def gsd_ci95_low_m_per_px(self) -> float | None:
        """Lower end of the 95 % interval, in metres per pixel."""

    @property
    def gsd_ci95_high_m_per_px(self) -> float | None:
        """Upper end of the 95 % interval, in metres per pixel."""


def with_capital(words: str) -> str:
    """Begin words with a capital letter, and leave the others as they are."""
    return f"{words[0].upper()}{words[1:]}"


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
    value: float | None,
    low: float | None,
    high: float | None,
    unit: str,
    *,
    missing: str = "",
    premise: str = "",
) -> str:
    """Format a quantity with four digits, and with its 95 % interval if it has one.

    Args:
        value: the quantity; None gives ``missing``.
        low: lower end of the interval; None for no interval.
        high: upper end of the interval.
        unit: unit of all three.
        missing: text for a missing quantity.
        premise: premise of the interval; empty for none.
    """
    if value is None:
        return missing
    text = f"{significant(value, 4)} {unit}"
    if low is not None and high is not None:
        interval = f"95 %: {significant(low, 4)} to {significant(high, 4)} {premise}"
        text += f"  ({interval.rstrip()})"
    return text


def count(number: int, noun: str) -> str:
    """Format a number of things, such as "1 vehicle" and "2 vehicles"."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def fit_in_words(fit: Fit, *, has_scale: bool = True) -> str:
    """State what must fit, and with which probability it does; unknown without a scale."""
    if fit.diameter_m is not None:
        shape = f"a circle of {fit.diameter_m:g} m"
    else:
        shape = f"{fit.length_m:g} x {fit.width_m:g} m"
    if not has_scale:
        return f"whether {shape} fits is unknown without a scale"
    # Never rounded up to a limit that the probability does not reach.
    probability = math.floor(fit.fit_probability * 100) / 100
    text = f"{shape} fits with probability {probability:.2f}"
    if fit.n_fits_at_least is not None and fit.n_fits_at_least > 1:
        text += f", at least {fit.n_fits_at_least} in rows even if the scale is at its low end"
    return text


def scale_text(record: Scale) -> str:
    """Format the scale with its interval, or say that there is none."""
    return with_interval(
        record.gsd_m_per_px,
        record.gsd_ci95_low_m_per_px,
        high=record.gsd_ci95_high_m_per_px,
        unit="m/px",
        missing=NO_SCALE,
        premise=INTERVAL_PREMISE,
    )


def scale_cells(record: Scale) -> tuple[str, str]:
    """Format the scale and its interval as two cells of a table; "-" for what is unknown."""
    scale = "-"
    if record.gsd_m_per_px is not None:
        scale = significant(record.gsd_m_per_px, 4)
    interval = "-"
    low = record.gsd_ci95_low_m_per_px
    high = record.gsd_ci95_high_m_per_px
    if low is not None and high is not None:
        interval = f"{significant(low)} to {significant(high)}"
    return scale, interval


def pixel_text(gsd_m_per_px: float | None, pixel_aspect: float | None) -> str:
    """Describe a pixel of the file that is not square; empty for a square one.

    Args:
        gsd_m_per_px: scale, metres per square pixel; None without one.
        pixel_aspect: height of the file's pixel over its width; None for a square one.
    """
    if pixel_aspect is None:
        return ""
    if gsd_m_per_px is None:
        return f"{significant(pixel_aspect)} times as high as wide"
    across_m = gsd_m_per_px * max(1.0, 1 / pixel_aspect)
    down_m = gsd_m_per_px * max(1.0, pixel_aspect)
    return f"{significant(across_m)} m across, {significant(down_m)} m down"


def file_source_text(record: AreaMeasurement | DistanceMeasurement) -> str:
    """State what the file's own scale, with which a record was measured, was compared with."""
    if record.n_vehicles is None:
        return "too large a file to be compared with cars"
    if not record.n_vehicles:
        return "no cars to compare with"
    return f"not contradicted by {count(record.n_vehicles, 'vehicle')}"


def file_scale_text(record: GsdEstimate | AreaMeasurement | DistanceMeasurement) -> str:
    """Format the scale of the file's georeference; empty without one.

    A pixel of the file that is not square has two sides.
    """
    gsd = record.georeference_gsd_m_per_px
    if gsd is None:
        return ""
    shaped = record.details if isinstance(record, GsdEstimate) else record
    pixel = pixel_text(gsd, shaped.pixel_aspect)
    text = f"{significant(gsd, 4)} m/px"
    return f"{text} ({pixel})" if pixel else text


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
    if estimate.n_vehicles == 0 and estimate.gsd_m_per_px is not None:
        vehicles = "vehicles of other photographs"
    names = []
    for ruler in estimate.probable_rulers:
        name = vehicles if ruler.kind == "vehicles" else ruler.label
        names.append(name)
    return " and ".join(names) or "no ruler that is probably right"
