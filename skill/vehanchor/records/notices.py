"""Notices in records, and their stable codes."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated

from pydantic import AfterValidator, Field

from vehanchor.records.escaping import on_one_line
from vehanchor.records.record import Record


class NoticeCode(StrEnum):
    """Codes of notices."""

    # About the image.
    PIXELS_STRETCHED = "pixels_stretched"
    PIXELS_NOT_SQUARE = "pixels_not_square"
    NOTHING_VISIBLE = "nothing_visible"
    NO_PHOTOGRAPH = "no_photograph"
    PART_SEARCHED = "part_searched"
    BESIDE_PHOTOGRAPH = "beside_photograph"
    BANDS_SELECTED = "bands_selected"
    PAGES_UNUSED = "pages_unused"
    SIDECAR_UNUSED = "sidecar_unused"
    DETAIL_MISSING = "detail_missing"
    GEOREFERENCE_DIFFERS = "georeference_differs"
    NOT_PERSPECTIVE = "not_perspective"
    SEVERAL_PICTURES = "several_pictures"
    HORIZON_VISIBLE = "horizon_visible"
    # About the search.
    DETECTIONS_CAPPED = "detections_capped"
    VEHICLES_COPIED = "vehicles_copied"
    # Doubts that the vehicles are cars with true proportions.
    STRETCHED = "stretched"
    LOOK_ALIKES = "look_alikes"
    SEVERAL_SCALES = "several_scales"
    ADDED_VEHICLE_UNLIKE = "added_vehicle_unlike"
    REFERENCE_LENGTH_UNLIKELY = "reference_length_unlikely"
    REGION_UNMEASURED = "region_unmeasured"
    # About other rulers than vehicles.
    RULERS_DISAGREE = "rulers_disagree"
    CAMERA_TILTED = "camera_tilted"
    TILT_SUSPECTED = "tilt_suspected"
    CAMERA_UNUSABLE = "camera_unusable"
    UNIT_MISTYPED = "unit_mistyped"
    KNOWN_LENGTHS_DISAGREE = "known_lengths_disagree"
    HEIGHT_REPEATED = "height_repeated"
    FACT_UNUSED = "fact_unused"
    # About a flight.
    NOT_LINKED = "not_linked"
    SEVERAL_SORTIES = "several_sorties"
    # About the mask of an object.
    MASK_EMPTY = "mask_empty"
    MASK_SCORE_LOW = "mask_score_low"
    MASK_TOUCHES_EDGE = "mask_touches_edge"
    MASK_LEAVES_BOX = "mask_leaves_box"
    MASK_IN_PIECES = "mask_in_pieces"
    MASK_DEPENDS_ON_BOX = "mask_depends_on_box"
    TARGET_SMALL = "target_small"
    EXTENT_UNKNOWN = "extent_unknown"


class Notice(Record):
    """Warning about a valid result."""

    code: str = Field(description="Stable identifier of the warning.")
    message: Annotated[str, AfterValidator(on_one_line)] = Field(
        description="The fact with its value, and its meaning for the result."
    )
