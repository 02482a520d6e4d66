"""Results in words: what a model reads beside the record, and what it should do."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vehanchor.records import GsdEstimate

__all__ = ["describe_estimate"]


def _metres(value: float) -> str:
    return f"{value:.3g}"


def describe_estimate(estimate: GsdEstimate) -> str:
    """One sentence with the scale and whether to use it, and one for each warning."""
    words = [_scale_in_words(estimate)]
    frame = estimate.frame
    if frame is not None and frame.gsd_m_per_px is not None:
        words.append(f"In your {frame.width_px} x {frame.height_px} copy that is {_metres(frame.gsd_m_per_px)} m/px.")
    words += [f"Warning {notice.code}: {notice.message}" for notice in estimate.warnings]
    return " ".join(words)


def _scale_in_words(estimate: GsdEstimate) -> str:
    if estimate.gsd_m_per_px is None:
        return "No vehicles found, confidence 0: no metric scale; use another anchor."
    scale = f"{_metres(estimate.gsd_m_per_px)} m/px"
    if estimate.gsd_ci95_low_m_per_px is not None and estimate.gsd_ci95_high_m_per_px is not None:
        low, high = _metres(estimate.gsd_ci95_low_m_per_px), _metres(estimate.gsd_ci95_high_m_per_px)
        scale += f" (95 % interval {low} to {high})"
    vehicles = f"{estimate.n_vehicles} vehicle{'' if estimate.n_vehicles == 1 else 's'}"
    scale += f", confidence {estimate.confidence:.2f} from {vehicles}: "
    if estimate.status == "ok":
        return scale + "safe to use."
    reason = "vehicles are too small to measure well" if estimate.resolution_guard else "too little evidence"
    return scale + f"do not rely on it ({reason}); fall back to another anchor."
