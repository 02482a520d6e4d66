"""Records of areas and distances, with their shapes in pixels of the image."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import Field

from vehanchor.records.gsd_estimate import GsdEstimate, KnownScale, PixelAspect, Status
from vehanchor.records.notices import Notice
from vehanchor.records.record import SCHEMA_VERSION, Record, SchemaVersion, Short

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

ScaleSource = Literal["estimated", "given", "reused", "file"]

# Fields that the records of areas and of distances share.
ScaleConfidence = Annotated[
    float | None,
    Short(when_null=True, round_down=True),
    Field(
        ge=0,
        le=1,
        description="The scale's confidence in 0..1; null for a number that the caller gave.",
    ),
]
MeasuredGsd = Annotated[
    float | None,
    Short(when_null=True),
    Field(
        description="Ground sampling distance, metres per pixel of the full image; null without a "
        "scale."
    ),
]
MeasuredVehicles = Annotated[
    int | None,
    Field(
        ge=0,
        description="N': vehicles behind the scale, or compared with the file's own; null without "
        "a search.",
    ),
]
ScaleSourceField = Annotated[
    ScaleSource,
    Field(
        description="estimated: from this image, by the rulers in estimate. given: a number from "
        "the caller. reused: an earlier estimate of this image, which the caller gave back. file: "
        "the georeference of the file, which no vehicles contradict."
    ),
]
FileGsd = Annotated[
    float | None,
    Field(
        description="The file's own scale by its georeference, metres per pixel, used or not; null "
        "without one."
    ),
]
ScaleField = Annotated[
    KnownScale | None,
    Field(
        description="The scale to give back for more measurements in this image; null for a "
        "number, the file's own scale, or no scale."
    ),
]
EstimateField = Annotated[
    GsdEstimate | None,
    Field(description="The whole estimate of the scale; null unless it was estimated now."),
]
ImageWidth = Annotated[int, Field(gt=0, description="Width of the full image, pixels.")]
ImageHeight = Annotated[int, Field(gt=0, description="Height of the full image, pixels.")]
Score = Annotated[float, Field(ge=0, le=1)]
MeasuredWarnings = Annotated[
    tuple[Notice, ...],
    Field(description="Further facts about this result and its scale, each with a stable code."),
]


class ImagePoint(Record):
    """Point in the image; the first pixel spans 0 to 1."""

    x_px: float = Field(description="Pixels from the left edge.")
    y_px: float = Field(description="Pixels from the upper edge.")

    def scaled(self, across: float, down: float) -> ImagePoint:
        """Scale the point to a copy of the image; see ``BoundingBox.scaled``."""
        return ImagePoint(x_px=self.x_px * across, y_px=self.y_px * down)


def image_points(places: NDArray[np.float64]) -> tuple[ImagePoint, ...]:
    """Make points of places ``[n, 2]``, pixels."""
    return tuple(ImagePoint(x_px=x, y_px=y) for x, y in places.tolist())


class BoundingBox(Record):
    """Upright box; the first pixel spans 0 to 1."""

    x1_px: float = Field(description="Left side, pixels from the left edge.")
    y1_px: float = Field(description="Upper side, pixels from the upper edge.")
    x2_px: float = Field(description="Right side, pixels from the left edge.")
    y2_px: float = Field(description="Lower side, pixels from the upper edge.")

    def scaled(self, across: float, down: float) -> BoundingBox:
        """Scale the box to a copy of the image.

        Args:
            across: width of the copy over that of the image.
            down: height of the copy over that of the image.
        """
        return BoundingBox(
            x1_px=self.x1_px * across,
            y1_px=self.y1_px * down,
            x2_px=self.x2_px * across,
            y2_px=self.y2_px * down,
        )


class OutlineRing(Record):
    """Closed line; the last point is joined to the first."""

    points: tuple[ImagePoint, ...] = Field(
        description="Corners in order, pixels of the full image."
    )

    @property
    def closed(self) -> list[list[float]]:
        """Coordinates of GeoJSON, which repeats the first corner."""
        ring = (*self.points, self.points[0])
        return _coordinates(ring)


class OutlinePolygon(Record):
    """Piece of an object's outline."""

    exterior: OutlineRing = Field(description="The line around the piece.")
    holes: tuple[OutlineRing, ...] = Field(description="The lines around its holes.")


class FrameArea(Record):
    """Object in the caller's resized copy."""

    width_px: int = Field(gt=0, description="Width of the caller's copy of the image, pixels.")
    height_px: int = Field(gt=0, description="Height of the caller's copy of the image, pixels.")
    gsd_m_per_px: Annotated[float | None, Short(when_null=True)] = Field(
        description="Metres per pixel of that copy; null without a scale."
    )
    bounding_box: Annotated[BoundingBox | None, Short(when_null=True)] = Field(
        description="The object's box in pixels of that copy; null without a mask."
    )
    fit_center: Annotated[ImagePoint | None, Short()] = Field(
        default=None, description="The centre of fit in pixels of that copy."
    )
    fit_corners: Annotated[tuple[ImagePoint, ...], Short()] = Field(
        default=(), description="The corners of fit in pixels of that copy."
    )


class OtherObject(Record):
    """Another object that the points may mean; its box is a prompt for it."""

    area_m2: float | None = Field(description="Its area, square metres; null without a scale.")
    mask_area_px: int = Field(gt=0, description="Square pixels of its mask in the full image.")
    mask_score: float = Field(ge=0, le=1, description="The segmenter's estimate of its mask's IoU.")
    bounding_box: BoundingBox = Field(description="Its box, pixels of the full image.")


class Fit(Record):
    """Whether the shape that must fit has room in the object, and where."""

    fit_probability: Annotated[float, Short(round_down=True)] = Field(
        ge=0,
        le=1,
        description="Probability that it fits, over the whole posterior of the scale and the error "
        "of the edge; at most the scale's confidence.",
    )
    center: Annotated[ImagePoint | None, Short()] = Field(
        default=None,
        description="Centre of the best place, pixels of the full image; null without one.",
    )
    heading_deg: Annotated[float | None, Short()] = Field(
        default=None,
        description="Direction of a rectangle's length in the image, degrees clockwise from up.",
    )
    corners: Annotated[tuple[ImagePoint, ...], Short()] = Field(
        default=(),
        description="Corners of a rectangle of that size at the best place, pixels of the full "
        "image; empty for a circle and without a scale.",
    )
    n_fits_at_least: Annotated[int | None, Short()] = Field(
        default=None,
        ge=0,
        description="Rectangles that fit in rows at that heading, even at the lower end of the "
        "scale's interval; more may fit otherwise. Null for a circle.",
    )
    diameter_m: float | None = Field(default=None, description="Diameter of the circle, metres.")
    length_m: float | None = Field(default=None, description="Length of the rectangle, metres.")
    width_m: float | None = Field(default=None, description="Width of the rectangle, metres.")


class AreaMeasurement(Record):
    """Area of an object: the pixels of its mask or polygon times the square of the scale."""

    status: Annotated[Status, Short()] = Field(
        description="ok: scale and mask are usable. low_confidence: the scale is not usable, the "
        "score of the mask is below the model's limit, the mask depends on the box too much, "
        "the object lies beside the photograph in a page, or there is no mask. no_scale: there is "
        "no scale, so sizes are in pixels only."
    )
    area_m2: Annotated[float | None, Short(when_null=True)] = Field(
        description="mask_area_px, or polygon_area_px, times GSD squared, square metres, summed "
        "over the ground plane for a tilted camera; null without a scale."
    )
    area_ci95_low_m2: Annotated[float | None, Short()] = Field(
        description="Lower end of its 95 % interval, from the errors of scale and mask."
    )
    area_ci95_high_m2: Annotated[float | None, Short()] = Field(
        description="Upper end of its 95 % interval."
    )
    scale_confidence: ScaleConfidence
    gsd_m_per_px: MeasuredGsd
    n_vehicles: MeasuredVehicles
    mode_length_px: float | None = Field(
        description="P_mode: modal vehicle length, pixels; null without an estimate."
    )
    scale_source: ScaleSourceField
    georeference_gsd_m_per_px: FileGsd = None
    mask_area_px: Annotated[int, Short()] = Field(
        ge=0,
        description="N_px: pixels of the mask in the full image, square ones of the side "
        "gsd_m_per_px even if the file's are not.",
    )
    polygon_area_px: float | None = Field(
        default=None,
        gt=0,
        description="Area of the caller's polygon by its corners, pixels; null for a mask.",
    )
    mask_score: Annotated[Score | None, Short(round_down=True)] = Field(
        description="The segmenter's estimate of the mask's IoU; null for the caller's own shape."
    )
    perimeter_m: float | None = Field(
        description="Length of the mask's outline with its holes, metres."
    )
    length_m: Annotated[float | None, Short(only_if_ok=True)] = Field(
        description="Longer side of the smallest rotated rectangle, metres."
    )
    width_m: Annotated[float | None, Short(only_if_ok=True)] = Field(
        description="Shorter side of that rectangle, metres."
    )
    inscribed_diameter_m: Annotated[float | None, Short(only_if_ok=True)] = Field(
        description="Diameter of the largest circle inside the mask, metres, for landing sites."
    )
    inscribed_diameter_ci95_low_m: Annotated[float | None, Short(only_if_ok=True)] = Field(
        description="Lower end of its 95 % interval."
    )
    inscribed_diameter_ci95_high_m: float | None = Field(
        description="Upper end of its 95 % interval."
    )
    inscribed_center: Annotated[ImagePoint | None, Short(only_if_ok=True)] = Field(
        description="Centre of that circle, pixels of the full image; null without a mask."
    )
    fit: Annotated[Fit | None, Short()] = Field(
        default=None,
        description="Whether the shape of must_fit fits; null without must_fit or a mask.",
    )
    bounding_box: Annotated[BoundingBox | None, Short()] = Field(
        description="The mask's box, pixels of the full image; null without a mask."
    )
    alternatives: tuple[OtherObject, ...] = Field(
        default=(),
        description="Other objects that the points may mean, best score first; empty for a box.",
    )
    outline: tuple[OutlinePolygon, ...] = Field(
        description="The mask's outline for drawing, largest piece first, simplified to at most "
        "200 points. Areas come from the mask itself."
    )
    image_width_px: ImageWidth
    image_height_px: ImageHeight
    pixel_aspect: PixelAspect = None
    frame: Annotated[FrameArea | None, Short()] = Field(
        description="The object in the caller's resized copy; null without a frame."
    )
    scale: ScaleField
    estimate: EstimateField
    segmenter: str | None = Field(
        description="Name of the segmenter; null for the caller's own shape."
    )
    segmenter_sha256: str | None = Field(
        description="SHA-256 of the segmenter's encoder file followed by its decoder file; null "
        "for the caller's own shape."
    )
    warnings: MeasuredWarnings
    schema_version: SchemaVersion = SCHEMA_VERSION

    @property
    def __geo_interface__(self) -> dict[str, Any]:
        """Outline as a GeoJSON MultiPolygon, for shapely, geopandas and fiona; pixels, y down."""
        polygons = []
        for piece in self.outline:
            rings = (piece.exterior, *piece.holes)
            polygons.append([ring.closed for ring in rings])
        return {"type": "MultiPolygon", "coordinates": polygons}


class DistanceMeasurement(Record):
    """Length of a line on the ground: its pixels times the scale."""

    status: Annotated[Status, Short()] = Field(
        description="ok: the scale is usable. low_confidence: the scale is not usable, or "
        "the line leaves the photograph in a page. no_scale: there is no scale, so the length is "
        "in pixels only."
    )
    distance_m: Annotated[float | None, Short(when_null=True)] = Field(
        description="length_px times GSD, metres, along the ground plane for a tilted camera; null "
        "without a scale."
    )
    distance_ci95_low_m: Annotated[float | None, Short()] = Field(
        description="Lower end of its 95 % interval, from the error of the scale and one pixel of "
        "error per point."
    )
    distance_ci95_high_m: Annotated[float | None, Short()] = Field(
        description="Upper end of its 95 % interval."
    )
    scale_confidence: ScaleConfidence
    gsd_m_per_px: MeasuredGsd
    n_vehicles: MeasuredVehicles
    scale_source: ScaleSourceField
    georeference_gsd_m_per_px: FileGsd = None
    length_px: float = Field(
        gt=0, description="Length of the line, square pixels of the full image."
    )
    path: tuple[ImagePoint, ...] = Field(
        description="Its points in order, pixels of the full image."
    )
    image_width_px: ImageWidth
    image_height_px: ImageHeight
    pixel_aspect: PixelAspect = None
    scale: ScaleField
    estimate: EstimateField
    warnings: MeasuredWarnings
    schema_version: SchemaVersion = SCHEMA_VERSION

    @property
    def __geo_interface__(self) -> dict[str, Any]:
        """Path as a GeoJSON LineString, for shapely, geopandas and fiona; pixels, y down."""
        return {"type": "LineString", "coordinates": _coordinates(self.path)}


def _coordinates(points: tuple[ImagePoint, ...]) -> list[list[float]]:
    return [[point.x_px, point.y_px] for point in points]
