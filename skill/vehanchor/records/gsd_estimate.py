"""The record of a scale, with the known scale that a caller gives back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError

from vehanchor.errors import InvalidParameterError
from vehanchor.records.notices import Notice
from vehanchor.records.record import (
    CI95_HIGH,
    CI95_LOW,
    SCHEMA_VERSION,
    Record,
    SchemaVersion,
    Short,
)
from vehanchor.records.ruler_registry import RulerKind
from vehanchor.scale.defaults import Aggregation, Preset, Reason, Remedy, Stopped

Status = Literal["ok", "low_confidence", "no_scale"]
ReferenceSource = Literal["model", "appearance", "region", "given", "calibration"]

_MAX_M_PER_PX = 1e9  # above every estimate, with a finite square


class ConfidenceTerms(Record):
    """Terms of the composite confidence before weighting, each in 0..1 (paper, section III-D)."""

    sample: float = Field(
        ge=0,
        le=1,
        description="Sample sufficiency, weight 0.35: rises with the number of vehicles.",
    )
    concentration: float = Field(
        ge=0,
        le=1,
        description="Weight 0.35: falls with the coefficient of variation of the lengths; 0 below "
        "5 vehicles.",
    )
    quality: float = Field(ge=0, le=1, description="Weight 0.20: from the median detection score.")
    plausibility: float = Field(
        ge=0,
        le=1,
        description="Weight 0.10: 1 if the modal length is in the range of the model.",
    )


class FrameScale(Record):
    """Scale in the caller's resized copy."""

    width_px: int = Field(gt=0, description="Width of the caller's copy of the image, pixels.")
    height_px: int = Field(gt=0, description="Height of the caller's copy of the image, pixels.")
    gsd_m_per_px: Annotated[float | None, Short(when_null=True)] = Field(
        description="Metres per pixel of that copy; null without a scale."
    )
    gsd_ci95_low_m_per_px: float | None = Field(description=CI95_LOW)
    gsd_ci95_high_m_per_px: float | None = Field(description=CI95_HIGH)


class SceneScaleEstimate(Record):
    """Scale from the appearance of the scene: a prior, not usable by itself."""

    gsd_m_per_px: float = Field(
        gt=0, description="Metres per pixel of the full image, the middle of its interval."
    )
    gsd_ci95_low_m_per_px: float = Field(gt=0, description="Lower end of its 95 % interval.")
    gsd_ci95_high_m_per_px: float = Field(gt=0, description="Upper end of its 95 % interval.")


class VehiclesByHand(Record):
    """Vehicles that the caller dropped and added; nothing in the image confirms them."""

    dropped: int = Field(ge=0, description="Detections that are not cars, according to the caller.")
    added: int = Field(ge=0, description="Cars that the detector missed, according to the caller.")


class ExpectedGain(Record):
    """What one remedy would bring, if it agrees with the likeliest scale."""

    remedy: Remedy = Field(
        description="What the caller would do. add: mark one more car. drop: drop the vehicles "
        "named here, if they are not cars. region: name it. line: draw a line over parking bays. "
        "things: draw lines over two different things of exact size. length, height: measure one. "
        "images: give photographs of the same flight with cars."
    )
    confidence: float = Field(ge=0, le=1, description="Expected confidence with it.")
    gsd_ci95_ratio: float = Field(
        ge=1, description="Expected high end of the 95 % interval over its low end."
    )
    vehicles: tuple[int, ...] = Field(
        default=(), description="Numbers of the vehicles that it is about; empty for none, or many."
    )


class RulerScale(Record):
    """Scale from one ruler, and its part in the estimate."""

    kind: RulerKind = Field(description="Name of the ruler in options and tables.")
    label: str = Field(description="Name of the ruler in messages and pictures.")
    sets_scale: bool = Field(
        description="Whether it can set the scale; a prior can only support other rulers."
    )
    gsd_m_per_px: float = Field(
        gt=0, description="Scale from this ruler alone, metres per pixel of the full image."
    )
    density_median_m_per_px: float = Field(
        gt=0,
        description="Median of the density with which this ruler counts if it is right. For "
        "vehicles it can differ from their own scale, because all boxes vote.",
    )
    gsd_ci95_low_m_per_px: float = Field(
        gt=0, description="Lower end of its 95 % interval, if it is right."
    )
    gsd_ci95_high_m_per_px: float = Field(
        gt=0, description="Upper end of its 95 % interval, if it is right."
    )
    n: int = Field(
        ge=0, description="Number of things measured: vehicles, lines, tiles of the scene."
    )
    p_right: float = Field(
        ge=0,
        le=1,
        description="Chance that it measured what it is meant to measure, given all rulers; the "
        "chances of all rulers do not add up to 1.",
    )
    probably_right: bool = Field(description="Whether that chance is at least one half.")
    explanation: str | None = Field(
        description="Explanation of the measurement in one sentence; null if none is needed."
    )


class TiltEstimate(Record):
    """Tilt of the camera, with which the scale varies over the image.

    Lengths and areas are measured on the ground plane.
    """

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
        description="Smallest metres per pixel in the image; null without a scale."
    )
    gsd_largest_m_per_px: float | None = Field(
        description="Largest metres per pixel in the image; null without a scale."
    )


PixelAspect = Annotated[
    float | None,
    Short(),
    Field(
        exclude_if=lambda aspect: aspect is None,
        description="Height of a pixel of the file over its width, on the ground; absent for "
        "square pixels. gsd_m_per_px, and lengths and areas in pixels, are in square pixels of the "
        "shorter side; coordinates are in pixels of the file.",
    ),
]
"""Shape of the file's pixels."""


class EstimateDetails(Record):
    """Details of an estimate: its search, its vehicles, and the paper's statistics."""

    preset: Preset | None = Field(description="Named preset of the method; null for none.")
    scene_scale: SceneScaleEstimate | None = Field(
        description="Scale from the appearance of the scene, a prior; null if it was not computed."
    )
    n_detections: int | None = Field(
        ge=0,
        description="N: vehicles before the outlier filter, after corrections by hand; null "
        "without the ruler vehicles.",
    )
    pixel_aspect: PixelAspect = None
    by_hand: Annotated[VehiclesByHand | None, Short()] = Field(
        default=None, description="Corrections by the caller; null without any."
    )
    remedies: tuple[ExpectedGain, ...] = Field(
        default=(),
        description="What would help, the best first; empty for a usable scale.",
    )
    working_scale: float | None = Field(
        description="Size of the image copy with most of the kept vehicles: 1 (full resolution), "
        "0.5, 0.25 or 0.125; null without vehicles. Lengths are always in pixels of the full image."
    )
    tiles_searched: int = Field(
        ge=0, description="Tiles searched; 0 if no ruler needs the detector."
    )
    tiles_total: int = Field(ge=0, description="Tiles of the image at all resolutions.")
    candidates_skipped: int = Field(
        default=0,
        ge=0,
        description="Candidates that were left out in crowded tiles; N' counts the others.",
    )
    stopped_because: Stopped | None = Field(
        description="Why the search ended. all_searched: all tiles were searched. converged: more "
        "tiles would not change the scale, or cannot show cars at their resolution. max_tiles, "
        "max_seconds: the limit was reached. Null without a search."
    )
    aggregation: Aggregation | None = Field(
        description="Statistic of the lengths: the mode, or the median below 5 vehicles; null "
        "without the ruler vehicles."
    )
    reference_length_m: float | None = Field(
        gt=0,
        description="L_ref: vehicle length that corresponds to P_mode, metres; null without the "
        "ruler vehicles.",
    )
    reference_source: ReferenceSource | None = Field(
        description="Source of L_ref. model: the detector's default. appearance: the fleet, "
        "recognised by its appearance. region, given, calibration: the caller or the operator. "
        "Null without the ruler vehicles."
    )
    resolution_guard: bool | None = Field(
        description="Whether the resolution guard applies because the vehicles have too few "
        "pixels; null without the ruler vehicles."
    )
    composite_confidence: float | None = Field(
        ge=0,
        le=1,
        description="The paper's composite confidence C of the vehicles: the weighted sum of its "
        "terms, capped.",
    )
    confidence_terms: ConfidenceTerms | None = Field(description="Terms of the composite C.")
    model_sha256: str = Field(description="SHA-256 of the detector's file.")


# Callers give back planes and scales, so validation is strict: true is not a number.


class KnownPlane(Record, strict=True):
    """Tilt of the camera, for a known scale of the image's centre."""

    tilt_deg: float = Field(
        gt=0, lt=90, description="Angle between the camera's axis and straight down."
    )
    roll_deg: float = Field(
        ge=-360, le=360, description="Direction of the tilt, clockwise from the image's upper side."
    )
    focal_length_px: float = Field(gt=0, description="Focal length, pixels of the full image.")


class KnownScale(Record, strict=True):
    """Scale to give back for the next measurement in the same image, without a search."""

    gsd_m_per_px: float = Field(gt=0, description="Metres per pixel of the full image.")
    gsd_ci95_low_m_per_px: float = Field(gt=0, description=CI95_LOW)
    gsd_ci95_high_m_per_px: float = Field(gt=0, description=CI95_HIGH)
    confidence: float = Field(ge=0, le=1, description="Confidence in the scale.")
    image_id: str = Field(
        max_length=64, description="Identifies the image; the scale holds for this image only."
    )
    model_id: str = Field(max_length=64, description="First digits of the detector's checksum.")
    plane: KnownPlane | None = Field(
        default=None,
        exclude_if=lambda plane: plane is None,
        description="Tilt of the camera; absent for a camera that points straight down.",
    )


class GsdEstimate(Record):
    """Metric scale of an aerial image: the paper's <GSD, C, N', P_mode> with its evidence."""

    status: Annotated[Status, Short()] = Field(
        description="ok: the scale is right within 20 % in at least 9 of 10 such photographs. "
        "low_confidence: do not act on the scale. no_scale: no ruler found anything."
    )
    gsd_m_per_px: Annotated[float | None, Short(when_null=True)] = Field(
        description="Ground sampling distance, metres per pixel of the full image; null without a "
        "scale."
    )
    confidence: Annotated[float, Short(round_down=True)] = Field(
        ge=0,
        le=1,
        description="Chance that the scale is right within 20 %; the status is ok from 0.9 on. "
        "With the preset paper, the composite C; the status is ok from 0.5 on.",
    )
    n_vehicles: Annotated[int | None, Short()] = Field(
        ge=0,
        description="N': vehicles kept after the outlier filter; null without the ruler vehicles.",
    )
    mode_length_px: float | None = Field(
        description="P_mode: modal vehicle length, pixels; null without vehicles."
    )
    gsd_ci95_low_m_per_px: Annotated[float | None, Short()] = Field(description=CI95_LOW)
    gsd_ci95_high_m_per_px: Annotated[float | None, Short()] = Field(description=CI95_HIGH)
    reason: Annotated[Reason | None, Short()] = Field(
        description="Why the scale is not usable; null for a usable scale. too_coarse: the "
        "vehicles have too few pixels. too_few: there is too little evidence. no_photograph: the "
        "image is a page, chart, map or program. oblique: the horizon is in it. not_cars: the "
        "vehicles may not be cars. disagree: rulers, or the directions of the image, contradict "
        "each other. assumed: it rests on assumed facts alone. imprecise: the fleet or the known "
        "fact is too uncertain."
    )
    leading_ruler: Annotated[RulerKind | None, Short()] = Field(
        description="Of the rulers that are probably right, the one without which the interval "
        "would be widest; null without a scale."
    )
    rulers: tuple[RulerScale, ...] = Field(
        description="All rulers with evidence; empty without a scale."
    )
    image_width_px: Annotated[int, Short()] = Field(
        gt=0, description="Width of the full image, pixels."
    )
    image_height_px: Annotated[int, Short()] = Field(
        gt=0, description="Height of the full image, pixels."
    )
    georeference_gsd_m_per_px: float | None = Field(
        description="Scale by the geotransform of the file, for comparison only; null without one."
    )
    tilt: TiltEstimate | None = Field(
        description="Tilt of the camera above 10 degrees, from the metadata; gsd_m_per_px is then "
        "the scale of the image's centre. Null at nadir or for an unknown tilt."
    )
    frame: Annotated[FrameScale | None, Short()] = Field(
        description="The scale in the caller's resized copy; null without a frame."
    )
    scale: KnownScale | None = Field(
        default=None,
        description="The scale to give back for measurements in this image without a search; null "
        "without a scale.",
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
    def pixels_per_meter(self) -> float | None:
        """Pixels of the full image per metre; None without a scale."""
        if self.gsd_m_per_px is None:
            return None
        return 1 / self.gsd_m_per_px

    @property
    def probable_rulers(self) -> list[RulerScale]:
        """Rulers that can set a scale and are probably right, the leading one first."""
        setting = [ruler for ruler in self.rulers if ruler.sets_scale]
        right = [ruler for ruler in setting if ruler.probably_right]
        return sorted(right, key=lambda ruler: ruler.kind != self.leading_ruler)


def read_known_scale(value: Any) -> KnownScale:
    """Read a scale that a caller gives back.

    Args:
        value: a ``KnownScale``, a record with one as its ``scale``, or either as a mapping.

    Raises:
        InvalidParameterError: the value is none of these, has no scale, or is not the scale of an
            estimate.
    """
    if isinstance(value, Mapping):
        scale = value.get("scale", value)
    else:
        scale = getattr(value, "scale", value)
    if scale is None:
        raise InvalidParameterError(
            "scale is a record without a scale: give an estimate that has one"
        )
    if isinstance(scale, Mapping):
        scale = _validate_known_scale(scale)
    if not isinstance(scale, KnownScale):
        raise InvalidParameterError(
            f"scale is a {type(scale).__name__}: give back an estimate or its scale; a number is "
            "gsd_m_per_px"
        )

    # The scale of an estimate lies inside its interval, and an image can have it.
    low = scale.gsd_ci95_low_m_per_px
    high = scale.gsd_ci95_high_m_per_px
    if not low <= scale.gsd_m_per_px <= high:
        raise InvalidParameterError(
            "scale is not what an estimate gave: its value lies outside its interval"
        )
    if not 1 / _MAX_M_PER_PX <= low <= high <= _MAX_M_PER_PX:
        raise InvalidParameterError(
            f"scale is not what an estimate gave: no image has {scale.gsd_m_per_px:g} m/px"
        )
    return scale


def _validate_known_scale(scale: Mapping[Any, Any]) -> KnownScale:
    try:
        return KnownScale.model_validate(scale)
    except ValidationError as error:
        detail = error.errors()[0]
        field = ".".join(map(str, detail["loc"])) or "scale"
        raise InvalidParameterError(
            f"scale is not what an estimate gave as scale: {field}: {detail['msg']}. Give it back "
            "unchanged"
        ) from None
