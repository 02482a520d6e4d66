"""Results in words: what a model reads beside the record, and what it should do."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from vehanchor.records import AreaMeasurement, GsdEstimate, Notice
    from vehanchor.scale.confidence import FleetDoubt

__all__ = ["describe_area", "describe_estimate"]

_FLEET_DOUBTS: tuple[FleetDoubt, ...] = (
    "lengths_disagree",
    "lengths_alike",
    "scores_unclear",
    "looks_alike",
    "looks_unlike_cars",
)


def describe_estimate(estimate: GsdEstimate) -> str:
    """One sentence with the scale and whether to use it, and one for each warning."""
    words = [_scale_in_words(estimate)]
    frame = estimate.frame
    if frame is not None and frame.gsd_m_per_px is not None:
        words.append(f"In your {frame.width_px} x {frame.height_px} copy that is {_rounded(frame.gsd_m_per_px)} m/px.")
    return " ".join([*words, *_warnings(estimate.warnings)])


def describe_area(area: AreaMeasurement) -> str:
    """One sentence with the area and whether to use it, one where the object lies, and one for each warning."""
    words = [_area_in_words(area)]
    box = area.bounding_box if area.frame is None else area.frame.bounding_box
    if box is not None:
        seen = "image" if area.frame is None else f"{area.frame.width_px} x {area.frame.height_px} copy"
        words.append(
            f"The mask spans x {box.x1_px:.0f} to {box.x2_px:.0f}, y {box.y1_px:.0f} to {box.y2_px:.0f} px of your "
            f"{seen}."
        )
    return " ".join([*words, *_warnings(area.warnings)])


def _rounded(value: float) -> str:
    """Three digits, or all before the point."""
    return f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"


def _interval(low: float | None, high: float | None) -> str:
    return "" if low is None or high is None else f" (95 % interval {_rounded(low)} to {_rounded(high)})"


def _warnings(notices: Iterable[Notice]) -> list[str]:
    return [f"Warning {notice.code}: {notice.message}" for notice in notices]


def _vehicles(number: int) -> str:
    return f"{number} vehicle{'' if number == 1 else 's'}"


def _scale_in_words(estimate: GsdEstimate) -> str:
    if estimate.gsd_m_per_px is None:
        return "No vehicles found, confidence 0: no metric scale; use another anchor."
    scale = f"{_rounded(estimate.gsd_m_per_px)} m/px"
    scale += _interval(estimate.gsd_ci95_low_m_per_px, estimate.gsd_ci95_high_m_per_px)
    scale += f", confidence {estimate.confidence:.2f} from {_vehicles(estimate.n_vehicles)}: "
    if estimate.status == "ok":
        return scale + "safe to use."
    return scale + f"do not rely on it ({_doubt(estimate)}); fall back to another anchor."


def _doubt(estimate: GsdEstimate) -> str:
    """Why the scale's confidence is low."""
    if estimate.resolution_guard:
        return "vehicles show too little detail to be measured well"
    if any(notice.code in _FLEET_DOUBTS for notice in estimate.warnings):
        return "the vehicles may not be cars"
    return "too little evidence"


def _area_in_words(area: AreaMeasurement) -> str:
    if not area.mask_area_px:
        return "No object found there: no area. Draw a box tightly around one that can be seen."
    if area.area_m2 is None:
        return (
            f"The object covers {area.mask_area_px} px, but no vehicles were found, confidence 0: no metric scale, so "
            "no area; use another anchor, and give its scale as gsd_m_per_px."
        )
    size = f"{_rounded(area.area_m2)} m2{_interval(area.area_ci95_low_m2, area.area_ci95_high_m2)}"
    if area.length_m is not None and area.width_m is not None and area.inscribed_diameter_m is not None:
        size += f", {_rounded(area.length_m)} x {_rounded(area.width_m)} m"
        size += f", largest circle inside {_rounded(area.inscribed_diameter_m)} m across"
    size += f"; {_origin(area)}: "
    if area.status == "ok":
        return size + ("as good as the given scale." if area.scale is None else "safe to use.")
    if area.scale is not None and area.scale.status != "ok":
        return size + f"do not rely on it ({_doubt(area.scale)}); fall back to another anchor."
    return size + "do not rely on it (the segmenter doubts its mask); look at the overlay, or draw another box."


def _origin(area: AreaMeasurement) -> str:
    """Where the scale comes from."""
    assert area.gsd_m_per_px is not None
    scale = f"scale {_rounded(area.gsd_m_per_px)} m/px"
    if area.confidence is None or area.n_vehicles is None:
        return f"{scale} as given"
    return f"{scale}, confidence {area.confidence:.2f} from {_vehicles(area.n_vehicles)}"
