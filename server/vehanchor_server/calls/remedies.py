"""Remedies for models: two, or all without a scale, the one that helps most first.

Each is given by arguments that every measuring tool has.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.records import AreaMeasurement, GsdEstimate
from vehanchor.records.advice import advice_for
from vehanchor.records.notices import NoticeCode
from vehanchor.scale.defaults import USABLE_CHANCE

if TYPE_CHECKING:
    from collections.abc import Mapping

    from pydantic import BaseModel

    from vehanchor.records import Remedy
    from vehanchor.records.advice import Advice

_MAX_REMEDIES = 2
_IN_WORDS: Mapping[Remedy, str] = {
    "original": "send the original image",
    "aspect": "send a copy with the aspect ratio of the original",
    "sides": "measure one length across and one down, and have the file's pixel sides corrected",
    "nadir": "send an image taken straight down",
    "lower": "send the original image",
    "visible": "send the original image",
    "perspective": "send one photograph that was taken straight down",
    "photograph": "send a photograph from above",
    "apart": "send each picture alone, as it was taken",
    "vehicles": "also use the ruler vehicles (rulers)",
    "facts": "check the facts that you gave, or leave out the wrong one",
    "drop": "drop boxes that are not cars, see view_image (drop)",
    "add": "add a car that has no box (add)",
    "region": "give the region (region)",
    "line": "draw a line over parking bays or lane dashes (known_lengths)",
    "things": "if cars, or two different things of known size, are in sight, mark them (add, "
    "known_lengths)",
    "length": "give a measured length (known_lengths)",
    "height": "give the height and lens (height_m, focal_35mm)",
    "images": "give photographs of the flight with cars (more_images)",
}
_MASK_DOUBTS = frozenset(
    {NoticeCode.MASK_SCORE_LOW, NoticeCode.MASK_DEPENDS_ON_BOX, NoticeCode.EXTENT_UNKNOWN}
)
_ON_BESIDE = "measure inside the photograph, or give the other picture alone"
_ON_STATED = "leave out gsd_m_per_px, and draw a line over something named (known_lengths)"
_ON_CHOICES = "give a tight box drawn by eye around the object that you mean"
_ON_MASK = "look at it with view_image, and give a tight box, or its outline (polygon), by eye"
_ON_SMALL = (
    "draw it again in an enlarged part (view_image, part): a box in the frame that it states, or "
    "its outline (polygon)"
)


def advice_on(record: BaseModel) -> str:
    """State what would make a record usable; empty for a usable one."""
    if getattr(record, "status", "ok") == "ok":
        return ""
    notices = getattr(record, "warnings", ())
    if any(notice.code == NoticeCode.BESIDE_PHOTOGRAPH for notice in notices):
        return _ON_BESIDE
    estimate = record if isinstance(record, GsdEstimate) else getattr(record, "estimate", None)
    advice = advice_for(estimate)
    if advice is not None:
        has_scale = estimate is not None and estimate.gsd_m_per_px is not None
        on_scale = _in_words(advice, has_scale=has_scale)
        # A scale that becomes usable does not make a doubtful mask so.
        if isinstance(record, AreaMeasurement) and _doubts_mask(record):
            return f"{on_scale}; and for the mask, {_advice_on_mask(record)}"
        return on_scale
    if isinstance(record, AreaMeasurement):
        confidence = record.scale_confidence
        if confidence is None or confidence >= USABLE_CHANCE:
            return _advice_on_mask(record)
    return _ON_STATED


def _in_words(advice: Advice, *, has_scale: bool) -> str:
    """Give the best remedies by arguments."""
    words = dict(_IN_WORDS)
    if advice.vehicles:
        words["drop"] = f"drop {advice.dropped}, see view_image (drop)"
    remedies = advice.remedies
    # Of a photograph without a scale, nobody knows what the caller has.
    if has_scale:
        remedies = remedies[:_MAX_REMEDIES]
    return ", or ".join(words[remedy] for remedy in remedies)


def _doubts_mask(area: AreaMeasurement) -> bool:
    """Test whether a mask needs a check, whatever the scale."""
    return any(notice.code in _MASK_DOUBTS for notice in area.warnings)


def _advice_on_mask(area: AreaMeasurement) -> str:
    """State what would make a mask usable."""
    codes = [notice.code for notice in area.warnings]
    if NoticeCode.MASK_DEPENDS_ON_BOX in codes:
        return _ON_SMALL
    return _ON_CHOICES if area.alternatives else _ON_MASK
