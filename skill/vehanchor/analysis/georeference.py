"""Comparison of an estimate with the scale that the georeference of its file states."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.scale.defaults import USABLE_CHANCE

if TYPE_CHECKING:
    from vehanchor.analysis.scale_analysis import ScaleAnalysis
    from vehanchor.scale.lengths import Interval

# Largest relative difference of the file's own scale without a warning.
GEOREFERENCE_TOLERANCE = 0.10


def weighed(analysis: ScaleAnalysis, chance: float) -> ScaleAnalysis:
    """Copy an analysis with the chance of its estimate beside the file's own scale.

    Args:
        analysis: an analysis of a georeferenced file.
        chance: 0..1, chance of the estimate, by the image and the georeference.
    """
    estimate = analysis.estimate
    changes: dict[str, Any] = {"confidence": chance}
    if estimate.scale is not None:
        changes["scale"] = estimate.scale.model_copy(update={"confidence": chance})
    if estimate.gsd_m_per_px is not None and chance < USABLE_CHANCE:
        changes |= {"status": "low_confidence", "reason": "disagree"}
    return replace(analysis, estimate=estimate.model_copy(update=changes))


def georeference_notice(
    own: float | None,
    gsd_m_per_px: float | None,
    source: str,
    *,
    interval: Interval | None = None,
) -> list[Notice]:
    """Warn if the file's own scale differs by more than a tenth, and lies outside the interval.

    Args:
        own: the file's scale, metres per pixel; None without one.
        gsd_m_per_px: the other scale; None without one.
        source: source of the other scale, as the middle of a sentence.
        interval: 95 % interval of the other scale; None if unknown.

    Returns:
        One notice, or none.
    """
    if own is None or gsd_m_per_px is None:
        return []
    if abs(gsd_m_per_px - own) <= GEOREFERENCE_TOLERANCE * own:
        return []
    if interval is not None and interval.low <= own <= interval.high:
        return []
    percent = 100 * (gsd_m_per_px / own - 1)
    message = (
        f"The file's own scale is {own:.4g} m/px, {source} {gsd_m_per_px:.4g} m/px: "
        f"{percent:+.0f} %. Check which of the two is wrong before using either: a resized copy "
        "may keep the georeference of the original."
    )
    return [Notice(code=NoticeCode.GEOREFERENCE_DIFFERS, message=message)]
