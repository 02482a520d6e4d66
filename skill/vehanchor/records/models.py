"""The records that callers get: frozen pydantic models, the single source of every schema.

Numbers are finite or null, units are in the names, and nothing is a bare array of numbers.
"""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from vehanchor.options.search import Stopped
from vehanchor.records.interop import as_frame, as_html, line_geometry, outline_geometry
from vehanchor.scale.defaults import Aggregation

Status = Literal["ok", "low_confidence", "no_scale"]
Reason = Literal["too_coarse", "too_few", "not_cars", "disagree", "lost", "imprecise"]
ScaleSource = Literal["estimated", "given", "reused"]
ReferenceSource = Literal["model", "appearance", "region", "given", "calibration"]


class _Record(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    def to_frame(self) -> Any:
        """Make a pandas table of one row, nested fields as ``outer_inner``.

        Raises:
            MissingExtraError: there is no pandas.
        """
        return as_frame([self.model_dump(mode="json")])

    def _repr_html_(self) -> str:
        """Show the single values in a notebook."""
        return as_html(self.model_dump(mode="json"))


class Notice(_Record):
    """Something a caller should know about a result that is valid all the same."""

    code: str = Field(description="Stable identifier of the warning.")
    message: str = Field(description="What was noticed, with its value, and what it means for the result.")


class ConfidenceTerms(_Record):
    """The four terms of the confidence before weighting, each in 0..1 (paper, section III-D)."""

    sample: float = Field(ge=0, le=1, description="Sample sufficiency, weight 0.35: grows with the number of vehicles.")
    concentration: float = Field(
        ge=0, le=1, description="Weight 0.35: falls with the lengths' coefficient of variation; 0 below 5 vehicles."
    )
    quality: float = Field(ge=0, le=1, description="Weight 0.20: from the median detection score.")
    plausibility: float = Field(
        ge=0, le=1, description="Weight 0.10: 1 where the modal length lies in the range the model measures well."
    )


class FrameScale(_Record):
    """The scale in the resized copy that the caller works in."""

    width_px: int = Field(gt=0, description="Width of the caller's copy of the image, pixels.")
    height_px: int = Field(gt=0, description="Height of the caller's copy of the image, pixels.")
    gsd_m_per_px: float | None = Field(description="Metres per pixel of that copy; null without an anchor.")
    gsd_ci95_low_m_per_px: float | None = Field(description="Lower end of its 95 % interval.")
    gsd_ci95_high_m_per_px: float | None = Field(description="Upper end of its 95 % interval.")


class SceneScaleEstimate(_Record):
    """What the ground itself tells of the scale: a witness, never enough to act on."""

    gsd_m_per_px: float = Field(gt=0, description="Metres per pixel of the full image: the middle of its interval.")
    gsd_ci95_low_m_per_px: float = Field(gt=0, description="Lower end of its 95 % interval.")
    gsd_ci95_high_m_per_px: float = Field(gt=0, description="Upper end of its 95 % interval.")


class RulerScale(_Record):
    """What one ruler says of the scale, and its part in the scale that is given out."""

    kind: str = Field(description="Name of the ruler in options and tables.")
    label: str = Field(description="Name of the ruler in messages and pictures.")
    sets_scale: bool = Field(description="Whether it can set the scale; a prior only weighs what others say.")
    gsd_m_per_px: float = Field(gt=0, description="What it says by itself, metres per pixel of the full image.")
    gsd_ci95_low_m_per_px: float = Field(gt=0, description="Lower end of its own 95 % interval.")
    gsd_ci95_high_m_per_px: float = Field(gt=0, description="Upper end of its own 95 % interval.")
    n: int = Field(ge=0, description="How many things it was measured on: vehicles, lines, tiles of the ground.")
    weight: float = Field(
        ge=0,
        le=1,
        description="Its share of the precision among the rulers whose densities make the scale; 0 for the others and "
        "for one that disagrees.",
    )
    agrees: bool = Field(description="Whether it agrees with the scale that is given out.")
    explanation: str | None = Field(
        description="What it was measured by, in a sentence; null where numbers say it all."
    )


class TiltEstimate(_Record):
    """A camera that looked aside: scales differ over the image, and lengths and areas are measured on a plane."""

    tilt_deg: float = Field(ge=0, le=90, description="Angle between the camera's axis and straight down.")
    tilt_ci95_low_deg: float = Field(ge=0, le=90, description="Lower end of its 95 % interval.")
    tilt_ci95_high_deg: float = Field(ge=0, le=90, description="Upper end of its 95 % interval.")
    roll_deg: float = Field(description="Direction in which it looked aside, clockwise from the image's upper side.")
    focal_length_px: float = Field(gt=0, description="Focal length, pixels of the full image.")
    source: str = Field(description="metadata, courts, vehicles, or several of them; focal length unknown, if it is.")
    gsd_least_m_per_px: float | None = Field(description="Least metres per pixel in the image; null without a scale.")
    gsd_largest_m_per_px: float | None = Field(description="Largest metres per pixel in the image.")


class KnownPlane(_Record, strict=True):
    """Where the camera looked, for a scale that is given back: it is that of the image's centre then."""

    tilt_deg: float = Field(gt=0, lt=90, description="Angle between the camera's axis and straight down.")
    roll_deg: float = Field(ge=-360, le=360, description="Direction in which it looked, clockwise from the upper side.")
    focal_length_px: float = Field(gt=0, description="Focal length, pixels of the full image.")


class KnownScale(_Record, strict=True):  # it comes back from callers: true is no metre
    """A scale to be given back for the next measurement in the same image, which then needs no search."""

    gsd_m_per_px: float = Field(gt=0, description="Metres per pixel of the full image.")
    gsd_ci95_low_m_per_px: float = Field(gt=0, description="Lower end of its 95 % interval.")
    gsd_ci95_high_m_per_px: float = Field(gt=0, description="Upper end of its 95 % interval.")
    confidence: float = Field(ge=0, le=1, description="Composite confidence C.")
    image_id: str = Field(max_length=64, description="Checksum of the image's pixels: it holds for no other image.")
    model_id: str = Field(max_length=64, description="First digits of the checksum of the detector.")
    plane: KnownPlane | None = Field(
        default=None,
        exclude_if=lambda plane: plane is None,
        description="Where the camera looked aside; absent where it did not.",
    )


class GsdEstimate(_Record):
    """Metric scale of an aerial image, the paper's record <GSD, C, N', P_mode> and where it comes from."""

    status: Status = Field(
        description="ok: confidence >= 0.5. low_confidence: below 0.5, fall back. no_scale: no ruler found, no scale."
    )
    gsd_m_per_px: float | None = Field(
        description="Ground sampling distance, metres per pixel of the full image; null without an anchor."
    )
    confidence: float = Field(
        ge=0,
        le=1,
        description="Below 0.5 use another anchor. The paper's composite C of the vehicles; with another ruler "
        "p_within_20, below 0.5 by the same rule.",
    )
    n_vehicles: int = Field(ge=0, description="N': vehicles kept after the outlier filter.")
    mode_length_px: float | None = Field(description="P_mode: modal vehicle length, pixels; null without vehicles.")
    gsd_ci95_low_m_per_px: float | None = Field(description="Lower end of the 95 % interval of the GSD.")
    gsd_ci95_high_m_per_px: float | None = Field(description="Upper end of the 95 % interval of the GSD.")
    p_within_20: float | None = Field(
        ge=0, le=1, description="Chance that the error is below 20 %; null without a scale, or for a foreign detector."
    )
    reason: Reason | None = Field(
        description="Why the scale is not to be used; null where it is. too_coarse: vehicles of too few pixels. "
        "too_few: not enough of them. not_cars: they may be something else. disagree: sizes, or rulers. "
        "lost: the scene is like none that was learned from. imprecise: the rulers leave it too open."
    )
    scene_scale: SceneScaleEstimate | None = Field(
        description="What the ground itself tells, a witness beside the vehicles; null where nothing looked at it."
    )
    scale_source: str | None = Field(
        description="The ruler that leads: the one of the largest weight; null without an anchor."
    )
    rulers: tuple[RulerScale, ...] = Field(
        description="All that were heard, and whether they agree with the scale; none without an anchor."
    )
    n_detections: int = Field(ge=0, description="N: vehicles detected, before the outlier filter.")
    working_scale: float | None = Field(
        description="Scale of the copy of the image where most of the kept vehicles were found: 1 (full resolution), "
        "0.5, 0.25 or 0.125; null without vehicles. All lengths are in pixels of the full image whatever it is."
    )
    tiles_searched: int = Field(ge=0, description="Tiles that were searched; 0 where no ruler needs the detector.")
    tiles_total: int = Field(ge=0, description="Tiles that the image has, at all resolutions.")
    stopped_because: Stopped | None = Field(
        description="Why the search ended. all_searched: no tile was left. settled: more tiles could not narrow the "
        "interval, or by the ground no car can be at their resolution. max_tiles, max_seconds: as limited. Null where "
        "none was searched."
    )
    aggregation: Aggregation = Field(description="How lengths became one: the mode, or the median below 5 vehicles.")
    reference_length_m: float = Field(gt=0, description="L_ref: vehicle length that P_mode stands for, metres.")
    reference_source: ReferenceSource = Field(
        description="Where L_ref is from. model: the detector's one number. appearance: told from the look of the "
        "vehicles, which fleet they are of. region, given, calibration: as the caller or the operator said."
    )
    resolution_guard: bool = Field(
        description="Whether the resolution guard capped the vehicles' confidence at 0.3: vehicles of too few pixels, "
        "or of too little detail for their pixels (an enlarged image)."
    )
    confidence_terms: ConfidenceTerms = Field(
        description="The terms that the vehicles' confidence is the weighted sum of."
    )
    image_width_px: int = Field(gt=0, description="Width of the full image, pixels.")
    image_height_px: int = Field(gt=0, description="Height of the full image, pixels.")
    georeference_gsd_m_per_px: float | None = Field(
        description="Scale that the file itself carries (geotransform), for comparison; never used for the estimate."
    )
    tilt: TiltEstimate | None = Field(
        description="Where the camera looked more than 10 degrees aside, by its metadata, courts and vehicles: "
        "gsd_m_per_px is then that of the image's centre. Null where it looked down, or nobody knows."
    )
    frame: FrameScale | None = Field(description="The scale in the caller's resized copy, where one was named.")
    scale: KnownScale | None = Field(
        default=None,
        description="The scale in six fields: give it back as scale to measure in the same image without another "
        "search; null without an anchor.",
    )
    model: str = Field(description="Name of the detector.")
    model_sha256: str = Field(description="SHA-256 of the detector's file.")
    warnings: tuple[Notice, ...] = Field(description="What else to know about this result.")


class ImagePoint(_Record):
    """A place in the image; the first pixel spans 0 to 1."""

    x_px: float = Field(description="Pixels from the left edge.")
    y_px: float = Field(description="Pixels from the upper edge.")


class BoundingBox(_Record):
    """An upright box; the first pixel spans 0 to 1."""

    x1_px: float = Field(description="Left side, pixels from the left edge.")
    y1_px: float = Field(description="Upper side, pixels from the upper edge.")
    x2_px: float = Field(description="Right side, pixels from the left edge.")
    y2_px: float = Field(description="Lower side, pixels from the upper edge.")


class OutlineRing(_Record):
    """A closed line; the last point is joined to the first."""

    points: tuple[ImagePoint, ...] = Field(description="Its corners in order, pixels of the full image.")


class OutlinePolygon(_Record):
    """One piece of an object's outline."""

    exterior: OutlineRing = Field(description="The line around the piece.")
    holes: tuple[OutlineRing, ...] = Field(description="The lines around its holes.")


class FrameArea(_Record):
    """The object in the resized copy that the caller works in."""

    width_px: int = Field(gt=0, description="Width of the caller's copy of the image, pixels.")
    height_px: int = Field(gt=0, description="Height of the caller's copy of the image, pixels.")
    gsd_m_per_px: float | None = Field(description="Metres per pixel of that copy; null without a scale.")
    bounding_box: BoundingBox | None = Field(description="The object's box in pixels of that copy; null for no mask.")


class AreaMeasurement(_Record):
    """Area of one object: the pixels of its mask times the square of the scale, and where both come from."""

    status: Status = Field(
        description="ok. low_confidence: the scale's confidence is below 0.5, or the mask's score below the model's "
        "limit, or there is no mask. no_scale: no scale, so pixels only."
    )
    area_m2: float | None = Field(
        description="mask_area_px times GSD squared, square metres, summed over the ground's plane where the camera "
        "looked aside; null without a scale."
    )
    area_ci95_low_m2: float | None = Field(description="Lower end of its 95 % interval: scale and mask together.")
    area_ci95_high_m2: float | None = Field(description="Upper end of its 95 % interval.")
    confidence: float | None = Field(
        ge=0, le=1, description="The scale's confidence in 0..1; null for a scale that the caller gave."
    )
    gsd_m_per_px: float | None = Field(
        description="Ground sampling distance, metres per pixel of the full image; null without an anchor."
    )
    n_vehicles: int | None = Field(ge=0, description="N': vehicles behind the scale; null for a given one.")
    mode_length_px: float | None = Field(description="P_mode: modal vehicle length, pixels; null without an estimate.")
    scale_source: ScaleSource = Field(
        description="estimated: by the rulers in scale. given: the caller's own scale. reused: an earlier estimate of "
        "this image, given back."
    )
    mask_area_px: int = Field(ge=0, description="N_px: pixels of the mask in the full image.")
    mask_score: float = Field(ge=0, le=1, description="The segmenter's own estimate of the mask's overlap (IoU).")
    perimeter_m: float | None = Field(description="Length of the mask's outline with its holes, metres.")
    length_m: float | None = Field(description="Longer side of the smallest rotated rectangle around it, metres.")
    width_m: float | None = Field(description="Shorter side of that rectangle, metres.")
    inscribed_diameter_m: float | None = Field(
        description="Diameter of the largest circle inside the mask, metres: what a landing needs."
    )
    inscribed_diameter_ci95_low_m: float | None = Field(description="Lower end of its 95 % interval.")
    inscribed_diameter_ci95_high_m: float | None = Field(description="Upper end of its 95 % interval.")
    inscribed_center: ImagePoint | None = Field(
        description="Centre of that circle, pixels of the full image; null for no mask."
    )
    bounding_box: BoundingBox | None = Field(description="The mask's box, pixels of the full image; null for no mask.")
    outline: tuple[OutlinePolygon, ...] = Field(
        description="The mask's outline, largest piece first, simplified to 200 points at most: for drawing. Areas "
        "come from the mask itself."
    )
    image_width_px: int = Field(gt=0, description="Width of the full image, pixels.")
    image_height_px: int = Field(gt=0, description="Height of the full image, pixels.")
    frame: FrameArea | None = Field(description="The object in the caller's resized copy, where one was named.")
    scale: GsdEstimate | None = Field(
        description="The whole estimate of the scale; null for one that was given or given back."
    )
    segmenter: str = Field(description="Name of the segmenter.")
    segmenter_sha256: str = Field(description="SHA-256 of the segmenter's encoder file followed by its decoder file.")
    warnings: tuple[Notice, ...] = Field(description="What else to know about this result, the scale's included.")

    @property
    def __geo_interface__(self) -> dict[str, Any]:
        """The outline as a GeoJSON MultiPolygon, which shapely, geopandas and fiona take; pixels, y down."""
        return outline_geometry(self.model_dump(mode="json", include={"outline"})["outline"])


class DistanceMeasurement(_Record):
    """Length of a line on the ground: its pixels times the scale, and where that comes from."""

    status: Status = Field(
        description="ok. low_confidence: the scale's confidence is below 0.5. no_scale: no scale, so pixels only."
    )
    distance_m: float | None = Field(description="length_px times GSD, metres; null without a scale.")
    distance_ci95_low_m: float | None = Field(
        description="Lower end of its 95 % interval: the scale, and a pixel at each point, together."
    )
    distance_ci95_high_m: float | None = Field(description="Upper end of its 95 % interval.")
    confidence: float | None = Field(
        ge=0, le=1, description="The scale's composite confidence C in 0..1; null for a scale that the caller gave."
    )
    gsd_m_per_px: float | None = Field(
        description="Ground sampling distance, metres per pixel of the full image; null without an anchor."
    )
    n_vehicles: int | None = Field(ge=0, description="N': vehicles behind the scale; null for a given one.")
    scale_source: ScaleSource = Field(
        description="estimated: from the vehicles. given: the caller's own scale. reused: an earlier estimate of this "
        "image, given back."
    )
    length_px: float = Field(gt=0, description="Length of the line, pixels of the full image.")
    path: tuple[ImagePoint, ...] = Field(description="Its points in order, pixels of the full image.")
    image_width_px: int = Field(gt=0, description="Width of the full image, pixels.")
    image_height_px: int = Field(gt=0, description="Height of the full image, pixels.")
    scale: GsdEstimate | None = Field(
        description="The whole estimate of the scale; null for one that was given or given back."
    )
    warnings: tuple[Notice, ...] = Field(description="What else to know about this result, the scale's included.")

    @property
    def __geo_interface__(self) -> dict[str, Any]:
        """The path as a GeoJSON LineString, which shapely, geopandas and fiona take; pixels, y down."""
        return line_geometry(self.model_dump(mode="json", include={"path"})["path"])


class FlightRuler(_Record):
    """A ruler that a photograph's scale hangs on, and the photographs in between."""

    ruler: str = Field(description="Kind of the ruler: vehicles, camera, positions, ...")
    photograph: str = Field(description="The photograph that it was seen in; the photograph itself, or another.")
    through: tuple[str, ...] = Field(
        description="Photographs in between, each of which overlaps the next; empty where it was seen in this one, or "
        "in one that overlaps it, or where all are of one scale."
    )


class FlightPhotograph(_Record):
    """One photograph of a flight: its scale by all evidence of the flight, and what it says by itself."""

    photograph: str = Field(description="The photograph, as the caller named it.")
    status: Status | Literal["error"] = Field(
        description="ok: confidence >= 0.5. low_confidence: below 0.5. no_scale: no scale. error: it cannot be read."
    )
    gsd_m_per_px: float | None = Field(description="Metres per pixel of this photograph, by all evidence.")
    gsd_ci95_low_m_per_px: float | None = Field(description="Lower end of its 95 % interval.")
    gsd_ci95_high_m_per_px: float | None = Field(description="Upper end of its 95 % interval.")
    confidence: float | None = Field(ge=0, le=1, description="Confidence in it; null for one that cannot be read.")
    component: int | None = Field(
        description="Number of the group of photographs that are tied to each other; null for one that cannot be read."
    )
    anchors: tuple[FlightRuler, ...] = Field(description="What its scale hangs on, the strongest first.")
    scale: KnownScale | None = Field(
        description="The scale to be given back for measurements in this photograph; null without one."
    )
    east_m: float | None = Field(description="Place of its centre, metres east (by overlaps: to the right).")
    north_m: float | None = Field(description="Metres north (overlaps: up).")
    placed_by: Literal["positions", "overlaps"] | None = Field(
        description="positions: by its metadata, from the first that has any. overlaps: by what it overlaps, from the "
        "island's reference and turned as it. Null: nowhere."
    )
    own: GsdEstimate | None = Field(description="What the photograph says by itself.")
    error_code: str | None = Field(description="Stable code of why it cannot be read.")
    error: str | None = Field(description="What was wrong and what to do.")


class FlightComponent(_Record):
    """Photographs that are tied to each other, by one scale or by what they overlap: one body of evidence."""

    number: int = Field(ge=0, description="Its number; the largest island is 0.")
    n_photographs: int = Field(ge=1, description="Its photographs.")
    reference: str = Field(description="The photograph in whose pixels all of its evidence was put together.")
    pooled: GsdEstimate = Field(description="What all evidence of the island says of that photograph's scale.")


class FlightLink(_Record):
    """Two photographs that overlap, and the ratio of their scales."""

    first: str = Field(description="One photograph.")
    second: str = Field(description="The other.")
    ratio: float = Field(gt=0, description="Metres per pixel of the first over those of the second.")
    ratio_log_sd: float = Field(ge=0, description="Standard deviation of its natural log.")
    n_matches: int = Field(ge=0, description="Points of the ground that were found in both.")
    dropped: str | None = Field(description="Why it was not used: what it contradicts; null where it was.")


class FlightEstimate(_Record):
    """Scales of the photographs of one flight, by the evidence of all of them."""

    status: Status = Field(
        description="ok: every photograph that can be read has a scale with a confidence >= 0.5. low_confidence: not "
        "all of them. no_scale: none has a scale."
    )
    same_scale: bool = Field(description="Whether the caller said that all photographs are of one scale.")
    gsd_m_per_px: float | None = Field(description="With same_scale that scale, metres per pixel; else null.")
    gsd_ci95_low_m_per_px: float | None = Field(description="Lower end of its 95 % interval.")
    gsd_ci95_high_m_per_px: float | None = Field(description="Upper end of its 95 % interval.")
    confidence: float = Field(ge=0, le=1, description="Of that scale; else the least of the photographs'.")
    n_vehicles: int = Field(ge=0, description="Vehicles that the scales were taken from.")
    photographs: tuple[FlightPhotograph, ...] = Field(description="In the order in which they were given.")
    components: tuple[FlightComponent, ...] = Field(description="The largest first; one with same_scale.")
    links: tuple[FlightLink, ...] = Field(description="Overlapping photographs; none with same_scale.")
    model: str = Field(description="Name of the detector.")
    model_sha256: str = Field(description="SHA-256 of the detector's file.")
    warnings: tuple[Notice, ...] = Field(description="What else to know about the flight.")
