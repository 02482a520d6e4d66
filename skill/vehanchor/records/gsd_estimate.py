"""The record of a scale, with the known scale that a caller gives back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from pydantic import Field, ValidationError

from vehanchor.errors import InvalidParameterError
from vehanchor.records.notices import Notice
from vehanchor.records.record import SCHEMA_VERSION, Record, SchemaVersion
from vehanchor.records.ruler_registry import RulerKind
from vehanchor.scale.defaults import Aggregation, Preset, Reason, Stopped

Status = Literal["ok", "low_confidence", "no_scale"]
ReferenceSource = Literal["model", "appearance", "region", "given", "calibration"]

_WIDEST_M_PER_PX = 1e9  # above every estimate, with a finite square


class ConfidenceTerms(Record):
    """Four terms of the composite confidence before weighting, each in 0..1 (paper, section III-D)."""

    sample: float = Field(
        ge=0,
        le=1,
        description="Sample sufficiency, weight 0.35: grows with the number of vehicles.",
    )
    concentration: float = Field(
        ge=0,
        le=1,
        description="Weight 0.35: falls with the lengths' coefficient of variation; 0 below 5 "
        "vehicles.",
    )
    quality: float = Field(ge=0, le=1, description="Weight 0.20: from the median detection score.")
    plausibility: float = Field(
        ge=0, le=1, description="Weight 0.10: 1 if the modal length is in the model's range."
    )


class FrameScale(Record):
    """Scale in the caller's resized copy."""

    width_px: int = Field(gt=0, description="Width of the caller's copy of the image, pixels.")
    height_px: int = Field(gt=0, description="Height of the caller's copy of the image, pixels.")
    gsd_m_per_px: float | None = Field(
        description="Metres per pixel of that copy; null without a scale."
    )
    gsd_ci95_low_m_per_px: float | None = Field(description="Lower end of its 95 % interval.")
    gsd_ci95_high_m_per_px: float | None = Field(description="Upper end of its 95 % interval.")


class SceneScaleEstimate(Record):
    """Scale from the appearance of the scene: a prior, not usable by itself."""

    gsd_m_per_px: float = Field(
        gt=0, description="Metres per pixel of the full image, the middle of its interval."
    )
    gsd_ci95_low_m_per_px: float = Field(gt=0, description="Lower end of its 95 % interval.")
    gsd_ci95_high_m_per_px: float = Field(gt=0, description="Upper end of its 95 % interval.")


class VehiclesByHand(Record):
    """Vehicles that the caller dropped and added: the caller's word, not the image's."""

    dropped: int = Field(ge=0, description="Detections that the caller says are no cars.")
    added: int = Field(ge=0, description="Cars that the caller pointed at.")


class RulerScale(Record):
    """Scale from one ruler, and its part in the estimate."""

    kind: RulerKind = Field(description="Name of the ruler in options and tables.")
    label: str = Field(description="Name of the ruler in messages and pictures.")
    sets_scale: bool = Field(
        description="Whether it can set the scale; a prior only weighs other rulers."
    )
    gsd_m_per_px: float = Field(
        gt=0, description="Scale from this ruler alone, metres per pixel of the full image."
    )
    gsd_ci95_low_m_per_px: float = Field(gt=0, description="Lower end of its own 95 % interval.")
    gsd_ci95_high_m_per_px: float = Field(gt=0, description="Upper end of its own 95 % interval.")
    n: int = Field(
        ge=0, description="Number of things measured: vehicles, lines, tiles of the scene."
    )
    p_right: float = Field(
        ge=0,
        le=1,
        description="Chance that it measured what it thinks, given all rulers; these do not add "
        "up to 1.",
    )
    probably_right: bool = Field(description="Whether that chance is at least one half.")
    explanation: str | None = Field(
        description="Explanation of the measurement in a sentence; null if not needed."
    )


class TiltEstimate(Record):
    """Tilt of the camera: the scale varies over the image; lengths and areas are measured on the ground plane."""

    tilt_deg: float = Field(
        ge=0, le=90, description="Angle between the camera's axis and straight down."
    )
    tilt_ci95_low_deg: float = Field(ge=0, le=90, description="Lower end of its 95 % interval.")
    tilt_ci95_high_deg: float = Field(ge=0, le=90, description="Upper end of its 95 % interval.")
    roll_deg: float = Field(
        description="Direction of the tilt, clockwise from the image's upper side."
    )
    focal_length_px: float = Field(gt=0, description="Focal length, pixels of the full image.")
    source: str = Field(description="Source of the angle, and whether the focal length is unknown.")
    gsd_least_m_per_px: float | None = Field(
        description="Least metres per pixel in the image; null without a scale."
    )
    gsd_largest_m_per_px: float | None = Field(description="Largest metres per pixel in the image.")


class EstimateDetails(Record):
    """Details of an estimate: its search, its vehicles, and the paper's statistics."""

    preset: Preset | None = Field(description="Named preset of the method; null for none.")
    scene_scale: SceneScaleEstimate | None = Field(
        description="Scale from the appearance of the scene, a prior; null if it was not computed."
    )
    n_detections: int | None = Field(
        ge=0,
        description="N: vehicles before the outlier filter, after corrections by hand; null "
        "without that ruler.",
    )
    by_hand: VehiclesByHand | None = Field(
        default=None, description="Corrections by the caller; null without any."
    )
    working_scale: float | None = Field(
        description="Scale of the image copy with most of the kept vehicles: 1 (full "
        "resolution), 0.5, 0.25 or 0.125; "
        "null without vehicles. Lengths are always in pixels of the full image."
    )
    tiles_searched: int = Field(
        ge=0, description="Tiles searched; 0 if no ruler needs the detector."
    )
    tiles_total: int = Field(ge=0, description="Tiles of the image at all resolutions.")
    candidates_skipped: int = Field(
        default=0,
        ge=0,
        description="Candidates in crowded tiles that were left out; N' counts the others.",
    )
    stopped_because: Stopped | None = Field(
        description="Why the search ended. all_searched: all tiles. converged: more tiles would "
        "not change the "
        "scale, or cannot show cars at their resolution. max_tiles, max_seconds: the limit. "
        "Null without a search."
    )
    aggregation: Aggregation | None = Field(
        description="Statistic of the lengths: the mode, or the median below 5 vehicles; null "
        "without that ruler."
    )
    reference_length_m: float | None = Field(
        gt=0, description="L_ref: vehicle length of P_mode, metres. Null likewise."
    )
    reference_source: ReferenceSource | None = Field(
        description="Source of L_ref. model: the detector's default. appearance: the fleet, "
        "recognised by its "
        "appearance. region, given, calibration: from the caller or the operator. Null likewise."
    )
    resolution_guard: bool | None = Field(
        description="Whether the resolution guard applies: the vehicles have too few pixels; "
        "null likewise."
    )
    composite_confidence: float | None = Field(
        ge=0,
        le=1,
        description="The paper's composite C of the vehicles: the weighted sum of its terms, "
        "capped.",
    )
    confidence_terms: ConfidenceTerms | None = Field(description="Terms of the composite C.")
    model_sha256: str = Field(description="SHA-256 of the detector's file.")


class KnownPlane(Record, strict=True):
    """Tilt of the camera, for a known scale of the image's centre."""

    tilt_deg: float = Field(
        gt=0, lt=90, description="Angle between the camera's axis and straight down."
    )
    roll_deg: float = Field(
        ge=-360, le=360, description="Direction of the tilt, clockwise from the image's upper side."
    )
    focal_length_px: float = Field(gt=0, description="Focal length, pixels of the full image.")


class KnownScale(Record, strict=True):  # input from callers: true is not a number
    """Scale to give back for the next measurement in the same image, without a search."""

    gsd_m_per_px: float = Field(gt=0, description="Metres per pixel of the full image.")
    gsd_ci95_low_m_per_px: float = Field(gt=0, description="Lower end of its 95 % interval.")
    gsd_ci95_high_m_per_px: float = Field(gt=0, description="Upper end of its 95 % interval.")
    confidence: float = Field(ge=0, le=1, description="Confidence in the scale.")
    image_id: str = Field(
        max_length=64, description="Identifies the image; the scale is for this image only."
    )
    model_id: str = Field(max_length=64, description="First digits of the detector's checksum.")
    plane: KnownPlane | None = Field(
        default=None,
        exclude_if=lambda plane: plane is None,
        description="Tilt of the camera; absent for a camera that points straight down.",
    )


class GsdEstimate(Record):
    """Metric scale of an aerial image: the paper's <GSD, C, N', P_mode> with its evidence."""

    status: Status = Field(
        description="ok: right within 20 % in at least 9 of 10 such photographs. "
        "low_confidence: do not act on the "
        "scale. no_scale: no ruler found anything."
    )
    gsd_m_per_px: float | None = Field(
        description="Ground sampling distance, metres per pixel of the full image; null without "
        "a scale."
    )
    confidence: float = Field(
        ge=0,
        le=1,
        description="Chance that the scale is right within 20 %; the status is ok from 0.9 on. "
        "In the preset paper the "
        "composite C, with 0.5 in place of 0.9.",
    )
    n_vehicles: int | None = Field(
        ge=0, description="N': vehicles kept after the outlier filter; null without that ruler."
    )
    mode_length_px: float | None = Field(
        description="P_mode: modal vehicle length, pixels; null without vehicles."
    )
    gsd_ci95_low_m_per_px: float | None = Field(
        description="Lower end of the 95 % interval of the GSD."
    )
    gsd_ci95_high_m_per_px: float | None = Field(
        description="Upper end of the 95 % interval of the GSD."
    )
    reason: Reason | None = Field(
        description="Why the scale is not usable; null for a usable one. too_coarse: vehicles "
        "of too few pixels. "
        "too_few: too little evidence. not_cars: the vehicles may not be cars. disagree: "
        "rulers, or the directions of "
        "the image. assumed: assumed facts alone. imprecise: the fleet or the fact is too "
        "uncertain."
    )
    leading_ruler: RulerKind | None = Field(
        description="The probably right ruler without which the interval is widest; null "
        "without a scale."
    )
    rulers: tuple[RulerScale, ...] = Field(
        description="All rulers with evidence; empty without a scale."
    )
    image_width_px: int = Field(gt=0, description="Width of the full image, pixels.")
    image_height_px: int = Field(gt=0, description="Height of the full image, pixels.")
    georeference_gsd_m_per_px: float | None = Field(
        description="Scale in the file (geotransform), for comparison only."
    )
    tilt: TiltEstimate | None = Field(
        description="Tilt of the camera above 10 degrees, from the metadata; gsd_m_per_px is "
        "then the "
        "scale of the image's centre. Null at nadir or for an unknown tilt."
    )
    frame: FrameScale | None = Field(
        description="The scale in the caller's resized copy; null without a frame."
    )
    scale: KnownScale | None = Field(
        default=None,
        description="The scale to give back for measurements in this image without a search; "
        "null without a scale.",
    )
    model: str = Field(description="Name of the detector.")
    warnings: tuple[Notice, ...] = Field(
        description="Further facts about this result, each with a stable code."
    )
    details: EstimateDetails = Field(
        description="The search, the vehicles, and the paper's statistics."
    )
    schema_version: SchemaVersion = SCHEMA_VERSION

    @property
    def probable_rulers(self) -> list[RulerScale]:
        """Rulers that can set a scale and are probably right, the leading one first."""
        right = [ruler for ruler in self.rulers if ruler.sets_scale and ruler.probably_right]
        return sorted(right, key=lambda ruler: ruler.kind != self.leading_ruler)


def read_known_scale(given: Any) -> KnownScale:
    """Read a scale that a caller gives back.

    Args:
        given: a ``KnownScale``, a record with one as its ``scale``, or either as a mapping.

    Raises:
        InvalidParameterError: the value is none of these, has no scale, or is not the scale of an
            estimate.
    """
    found = (
        given.get("scale", given) if isinstance(given, Mapping) else getattr(given, "scale", given)
    )
    if found is None:
        raise InvalidParameterError(
            "scale is a record without a scale: give an estimate that has one"
        )
    if isinstance(found, Mapping):
        try:
            found = KnownScale.model_validate(found)
        except ValidationError as error:
            wrong = error.errors()[0]
            place = ".".join(map(str, wrong["loc"])) or "scale"
            raise InvalidParameterError(
                f"scale is not what an estimate gave as scale: {place}: {wrong['msg']}. Give it "
                "back unchanged"
            ) from None
    if not isinstance(found, KnownScale):
        raise InvalidParameterError(
            f"scale is a {type(found).__name__}: give back an estimate or its scale; a number "
            "is gsd_m_per_px"
        )
    low = found.gsd_ci95_low_m_per_px
    high = found.gsd_ci95_high_m_per_px
    if not low <= found.gsd_m_per_px <= high:
        raise InvalidParameterError(
            "scale is not what an estimate gave: its value lies outside its interval"
        )
    if not 1 / _WIDEST_M_PER_PX <= low <= high <= _WIDEST_M_PER_PX:
        raise InvalidParameterError(
            f"scale is not what an estimate gave: {found.gsd_m_per_px:g} m/px is no image's"
        )
    return found
