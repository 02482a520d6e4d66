"""Remedies for models: at most two, the one that helps most first.

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

    from vehanchor.records.advice import Remedy

_MAX_REMEDIES = 2
_DRAW_LINE = "draw a line over a parking bay or lane dash (known_lengths)"
_IN_WORDS: Mapping[Remedy, str] = {
    "original": "send the original image",
    "aspect": "send a copy with the aspect ratio of the original",
    "nadir": "send an image taken straight down",
    "lower": "send the original image",
    "drop": "drop boxes that are not cars, see view_image (drop)",
    "add": "add a car that has no box (add)",
    "region": "give the region (region)",
    "line": _DRAW_LINE,
    "thing": "if a car or a court, container or rail is in sight, mark it (add, known_lengths)",
    "measured": "give a measured length or height, no further assumed one (basis)",
    "facts": "check the facts that you gave, or leave out the wrong one",
    "second": "if they are right, measure a second length or the height (known_lengths, height_m)",
    "elsewhere": "give the camera's height and lens (height_m, focal_35mm), or photographs with "
    "cars (more_images)",
    "vehicles": "also use the ruler vehicles (rulers)",
    "visible": "send the original image",
    "perspective": "send one photograph that was taken straight down",
    "photograph": "send a photograph from above",
    "apart": "send each picture alone, as it was taken",
}
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
    estimate = record if isinstance(record, GsdEstimate) else getattr(record, "estimate", None)
    advice = advice_for(estimate)
    if advice is not None:
        remedies = advice.remedies[:_MAX_REMEDIES]
        return ", or ".join(_IN_WORDS[remedy] for remedy in remedies)
    if isinstance(record, AreaMeasurement):
        confidence = record.scale_confidence
        if confidence is None or confidence >= USABLE_CHANCE:
            codes = [notice.code for notice in record.warnings]
            if NoticeCode.MASK_DEPENDS_ON_BOX in codes:
                return _ON_SMALL
            return _ON_CHOICES if record.alternatives else _ON_MASK
    return _ON_STATED
