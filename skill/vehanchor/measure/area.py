"""Areas of objects: in a box, at points, or in shapes of the caller's own.

Raster + prompt -> mask -> pixels x GSD^2 -> record. The scale comes from the whole image, or from
the caller. No language model takes part in the measurement.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.analysis.measurement_analysis import AreaAnalysis
from vehanchor.errors import PromptError
from vehanchor.imagery.limits import check_mask_bytes
from vehanchor.measure.beside import BESIDE_PHOTOGRAPH, is_object_beside
from vehanchor.measure.fit import find_fit
from vehanchor.measure.placed_shape import check_edge, place_shape
from vehanchor.measure.scale_source import find_measurement_scale
from vehanchor.measure.shapes import check_orientation
from vehanchor.options import ScaleOptions
from vehanchor.options.reading import CoordinateFrame
from vehanchor.records import (
    AreaMeasurement,
    BoundingBox,
    FrameArea,
    ImagePoint,
    OtherObject,
    OutlinePolygon,
    OutlineRing,
)
from vehanchor.records.measurement import image_points
from vehanchor.scale.lengths import Z95
from vehanchor.segmentation.doubts import edge_notices, mask_notices
from vehanchor.segmentation.prompt import Prompt, prompt_in_image
from vehanchor.segmentation.segmenter import Segmenter
from vehanchor.segmentation.shape import (
    MAX_OUTLINE_POINTS,
    inscribed_circle,
    perimeter,
    rotated_extents,
    trace_outline,
)

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster
    from vehanchor.measure.fit import MustFit
    from vehanchor.measure.placed_shape import PlacedShape
    from vehanchor.measure.polygon import Part
    from vehanchor.measure.scale_source import MeasurementScale, ScaleInput
    from vehanchor.measure.shapes import CallerShape, Orientation
    from vehanchor.options import Frame
    from vehanchor.options.pixel_grid import PixelGrid
    from vehanchor.records import Notice
    from vehanchor.records.measurement import Fit
    from vehanchor.scale.lengths import Spread
    from vehanchor.segmentation.object_mask import ObjectMask
    from vehanchor.segmentation.segmenter import Segmentation, SegmenterCard
    from vehanchor.segmentation.shape import Circle


@dataclass(frozen=True, kw_only=True)
class ShapeReading:
    """How the caller's shapes are read.

    Attributes:
        edge_px: how far their edge may lie from the object's; see ``place_shape``.
        orientation: whether they belong to the upright or the stored pixels; see ``place_shape``.
    """

    edge_px: float | None = None
    orientation: Orientation | None = None

    def __post_init__(self) -> None:
        check_edge(self.edge_px)
        check_orientation(self.orientation)


_USUAL_READING = ShapeReading()


@dataclass(frozen=True, eq=False, kw_only=True)
class _Object:
    """Object before its scale is known, in pixels of the image.

    Attributes:
        pixels: its mask: a segmentation, or the pixels of the caller's shape.
        prompt: what names it; empty for a shape of the caller.
        area_px: its area; that of a polygon by its corners.
        perimeter_px: length of its outline.
        extents_px: length and width of the smallest rotated rectangle around it.
        circle: the largest circle inside; None for an empty mask.
        area_log_sd: standard deviation of the log of its area, from the error of its edge.
        width_log_sd: least standard deviation of the log of what fits inside.
        outline: its outline for drawing.
        card: model card of the segmenter; None for a shape of the caller.
        score: the segmenter's estimate of the mask's IoU; None for a shape of the caller.
        parts: rings of the caller's polygon; empty for a mask.
        is_doubtful: whether the mask needs a check.
        notices: doubts about the mask.
        alternatives: other objects that the points may mean.
    """

    pixels: ObjectMask
    prompt: Prompt
    area_px: float
    perimeter_px: float
    extents_px: tuple[float, float]
    circle: Circle | None
    area_log_sd: float
    width_log_sd: float
    outline: tuple[OutlinePolygon, ...]
    card: SegmenterCard | None = None
    score: float | None = None
    parts: tuple[Part, ...] = ()
    is_doubtful: bool = False
    notices: tuple[Notice, ...] = ()
    alternatives: tuple[Segmentation, ...] = ()

    @property
    def edge_sd_px(self) -> float:
        """Standard deviation of the place of its edge, pixels: an offset of the whole outline."""
        return self.area_log_sd * self.area_px / self.perimeter_px


def analyse_objects(
    raster: Raster,
    subjects: Sequence[Prompt | CallerShape],
    segmenter: Segmenter | None,
    scale: ScaleInput,
    options: ScaleOptions,
    *,
    object_height_m: float | None = None,
    reading: ShapeReading = _USUAL_READING,
    must_fit: MustFit | None = None,
) -> tuple[AreaAnalysis, ...]:
    """Measure several objects of an open image with one search.

    Args:
        raster: the image.
        subjects: results of ``read_prompt`` and ``read_shapes``, in the caller's coordinates.
        segmenter: segments the objects of prompts; None without prompts.
        scale: the known scale, or the analysis that finds it.
        options: all options of the scale estimate.
        object_height_m: height of all objects above the ground.
        reading: how shapes are read.
        must_fit: shape that must fit into each object; None for none.

    Returns:
        For each subject the record, the mask, the prompt in pixels of the image and the analysis of
        the scale.

    Raises:
        VehAnchorError: see ``Engine.measure_area`` and ``Engine.measure_areas``.
    """
    options.frame.check(raster.grid)
    # All prompts first: they are faster than the masks, and an invalid one fails early.
    in_image: list[Prompt | PlacedShape] = []
    n_mask_bytes = 0
    for number, subject in enumerate(subjects, 1):
        if isinstance(subject, Prompt):
            in_image.append(prompt_in_image(subject, options.frame, raster.grid))
            continue
        try:
            shape = place_shape(
                subject,
                raster,
                options,
                edge_px=reading.edge_px,
                orientation=reading.orientation,
            )
        except PromptError as error:
            if len(subjects) == 1:
                raise
            raise PromptError(f"shape {number}: {error}") from None
        in_image.append(shape)
        n_mask_bytes += shape.pixels.mask.nbytes
        check_mask_bytes(n_mask_bytes, options.reading.limits)
    # Then the masks, which are faster than the search.
    objects = [
        _find_object(raster, subject, segmenter=segmenter, options=options) for subject in in_image
    ]
    measurement_scale = find_measurement_scale(
        raster, scale, options, object_height_m=object_height_m
    )
    analyses = []
    for subject, measured in zip(subjects, objects, strict=True):
        record = _measure_object(
            raster,
            measured,
            options=options,
            scale=measurement_scale,
            must_fit=must_fit,
        )
        analysis = AreaAnalysis(
            record,
            measured.pixels,
            measured.prompt,
            scale=measurement_scale.analysis,
            nadir=measurement_scale.plane is None,
            grid=raster.grid,
            name="" if isinstance(subject, Prompt) else subject.name,
        )
        analyses.append(analysis)
    return tuple(analyses)


def _find_object(
    raster: Raster,
    subject: Prompt | PlacedShape,
    *,
    segmenter: Segmenter | None,
    options: ScaleOptions,
) -> _Object:
    if not isinstance(subject, Prompt):
        return _given_object(raster, subject)
    assert segmenter is not None, "prompts need a segmenter"
    coordinates = CoordinateFrame(options.frame, raster.grid)
    segmentation = segmenter.segment(
        raster,
        subject,
        limits=options.reading.limits,
        copy_px=coordinates.side_of_copy_px,
    )
    return _segmented_object(raster, segmentation, prompt=subject, card=segmenter.card)


def _segmented_object(
    raster: Raster, segmentation: Segmentation, *, prompt: Prompt, card: SegmenterCard
) -> _Object:
    """Describe the object of a model's mask."""
    mask = segmentation.mask
    window = segmentation.window
    length_px, width_px = rotated_extents(mask)
    circle = inscribed_circle(mask)
    if circle is not None:
        x = circle.x + window.x_px
        y = circle.y + window.y_px
        circle = circle._replace(x=x, y=y)
    doubts = mask_notices(raster, segmentation, prompt=prompt, card=card, width_px=width_px)
    return _Object(
        pixels=segmentation,
        prompt=prompt,
        area_px=float(mask.sum()),
        perimeter_px=perimeter(mask),
        extents_px=(length_px, width_px),
        circle=circle,
        area_log_sd=card.area_log_sd(prompt, segmentation),
        width_log_sd=card.mask_width_log_sd,
        outline=_traced_outline(segmentation, raster.grid),
        card=card,
        score=segmentation.score,
        is_doubtful=card.is_doubtful(segmentation),
        notices=tuple(doubts),
        alternatives=segmentation.alternatives,
    )


def _given_object(raster: Raster, shape: PlacedShape) -> _Object:
    """Describe a shape of the caller."""
    n_corners = sum(len(ring) for part in shape.parts for ring in part)
    if 0 < n_corners <= MAX_OUTLINE_POINTS:
        outline = _outline(shape.parts, raster.grid)
    else:
        outline = _traced_outline(shape.pixels, raster.grid)
    # The edge lies up to so far inside or outside: 95 % of its errors. An offset of the outline
    # changes the area by the offset times the perimeter.
    area_error = shape.edge_px * shape.perimeter_px / shape.area_px
    return _Object(
        pixels=shape.pixels,
        prompt=Prompt(),
        area_px=shape.area_px,
        perimeter_px=shape.perimeter_px,
        extents_px=shape.extents_px,
        circle=shape.circle,
        area_log_sd=area_error / Z95,
        width_log_sd=0.0,
        outline=outline,
        parts=shape.parts,
        notices=tuple(edge_notices(raster, shape.pixels)),
    )


def _measure_object(
    raster: Raster,
    measured: _Object,
    *,
    options: ScaleOptions,
    scale: MeasurementScale,
    must_fit: MustFit | None,
) -> AreaMeasurement:
    """Make the record from an object and the scale."""
    pixels = measured.pixels
    circle = measured.circle
    length_px, width_px = measured.extents_px
    # None for an empty mask, too: it has no size, not a size of zero.
    window = pixels.window
    gsd = scale.gsd_over(pixels.mask, window.x_px, window.y_px)
    area, diameter = _sizes(measured, scale, gsd)
    centre = None
    if circle is not None:
        x_px, y_px = raster.grid.to_file((circle.x, circle.y)).tolist()
        centre = ImagePoint(x_px=x_px, y_px=y_px)
    mode_length_px = None
    if scale.estimate is not None:
        mode_length_px = scale.estimate.mode_length_px
    status = scale.status
    is_beside = is_object_beside(pixels, scale.part)
    notices = (*scale.notices, *measured.notices)
    if is_beside:
        notices = (*notices, BESIDE_PHOTOGRAPH)
    if status == "ok" and (measured.is_doubtful or is_beside):
        status = "low_confidence"
    box = _box(pixels, raster.grid)
    alternatives = [_other_object(other, scale, raster.grid) for other in measured.alternatives]
    card = measured.card
    fit = None
    if must_fit is not None and circle is not None:
        fit = find_fit(
            must_fit,
            pixels,
            scale,
            parts=measured.parts,
            edge_sd_px=measured.edge_sd_px,
            width_log_sd=measured.width_log_sd,
            at_most=_most_probability(measured, is_beside=is_beside),
        )
        fit = _fit_in_file(fit, raster.grid)
    frame = _frame_area(
        options.frame,
        raster.grid,
        gsd=scale.gsd_m_per_px,
        box=box,
        fit=fit,
    )
    return AreaMeasurement(
        status=status,
        area_m2=area.value,
        area_ci95_low_m2=area.low,
        area_ci95_high_m2=area.high,
        mode_length_px=mode_length_px,
        mask_area_px=int(pixels.mask.sum()),
        polygon_area_px=measured.area_px if measured.parts else None,
        mask_score=measured.score,
        perimeter_m=_metres(measured.perimeter_px, gsd),
        length_m=_metres(length_px, gsd),
        width_m=_metres(width_px, gsd),
        inscribed_diameter_m=diameter.value,
        inscribed_diameter_ci95_low_m=diameter.low,
        inscribed_diameter_ci95_high_m=diameter.high,
        inscribed_center=centre,
        fit=fit,
        bounding_box=box,
        alternatives=tuple(alternatives),
        outline=measured.outline,
        frame=frame,
        segmenter=None if card is None else card.name,
        segmenter_sha256=None if card is None else card.sha256,
        warnings=notices,
        **scale.fields(raster.grid),
    )


def _sizes(measured: _Object, scale: MeasurementScale, gsd: float | None) -> tuple[_Size, _Size]:
    """Compute the area, and the diameter of the largest circle inside.

    Args:
        measured: the object.
        scale: the scale.
        gsd: metres per pixel over the object; None without a scale or with an empty mask.
    """
    circle = measured.circle
    if gsd is None or circle is None:
        return _NO_SIZE, _NO_SIZE
    # The paper, section III-G: the area is the number of pixels times the scale squared, so the
    # log error of the scale counts twice.
    area_spread = scale.spread.times(2).plus(measured.area_log_sd)
    area = _Size.of(measured.area_px * gsd**2, area_spread)
    diameter_log_sd = _diameter_log_sd(
        measured.area_log_sd,
        measured.area_px,
        perimeter_px=measured.perimeter_px,
        diameter_px=circle.diameter,
    )
    diameter_spread = scale.spread.plus(max(diameter_log_sd, measured.width_log_sd))
    return area, _Size.of(circle.diameter * gsd, diameter_spread)


def _most_probability(measured: _Object, *, is_beside: bool) -> float | None:
    """Bound the probability that something fits into a doubtful object; None for any other."""
    if is_beside:
        return 0.0
    return measured.score if measured.is_doubtful else None


class _Size(NamedTuple):
    """Size in metres or square metres with its 95 % interval; None without a scale or a mask."""

    value: float | None
    low: float | None
    high: float | None

    @classmethod
    def of(cls, value: float, spread: Spread) -> _Size:
        low, high = spread.around(value)
        return cls(value, low, high)


_NO_SIZE = _Size(None, None, None)


def _metres(length_px: float, gsd: float | None) -> float | None:
    return None if gsd is None else length_px * gsd


def _diameter_log_sd(
    area_log_sd: float, area_px: float, *, perimeter_px: float, diameter_px: float
) -> float:
    """Propagate the mask's uncertainty to the diameter of its inscribed circle.

    An offset d of the outline changes the area by d times the perimeter and the diameter by 2 d.
    The relative error of the diameter is half of the area's for a disc, and equal to it for a
    narrow strip.
    """
    of_outline = 2 * area_log_sd * area_px / (perimeter_px * diameter_px)
    return max(area_log_sd / 2, of_outline)


def _other_object(
    segmentation: Segmentation, scale: MeasurementScale, grid: PixelGrid
) -> OtherObject:
    n_px = int(segmentation.mask.sum())
    box = _box(segmentation, grid)
    assert box is not None, "alternatives are not empty"
    window = segmentation.window
    gsd = scale.gsd_over(segmentation.mask, window.x_px, window.y_px)
    return OtherObject(
        area_m2=None if gsd is None else n_px * gsd**2,
        mask_area_px=n_px,
        mask_score=segmentation.score,
        bounding_box=box,
    )


def _box(pixels: ObjectMask, grid: PixelGrid) -> BoundingBox | None:
    """Return the box of a mask in pixels of the file; None for an empty mask."""
    bounds = pixels.bounding_box
    if bounds is None:
        return None
    corners = np.reshape(bounds, (2, 2))
    x1, y1, x2, y2 = grid.to_file(corners).ravel().tolist()
    return BoundingBox(x1_px=x1, y1_px=y1, x2_px=x2, y2_px=y2)


def _traced_outline(pixels: ObjectMask, grid: PixelGrid) -> tuple[OutlinePolygon, ...]:
    """Trace the outline of a mask, in pixels of the file."""
    window = pixels.window
    origin = (window.x_px, window.y_px)
    parts = []
    for rings in trace_outline(pixels.mask):
        parts.append([np.add(ring, origin) for ring in rings])
    return _outline(parts, grid)


def _outline(
    parts: Iterable[Sequence[NDArray[np.float64]]], grid: PixelGrid
) -> tuple[OutlinePolygon, ...]:
    """Make the outline of rings in square pixels of the image, in pixels of the file."""
    polygons = []
    for rings in parts:
        in_file = [_outline_ring(grid.to_file(ring)) for ring in rings]
        exterior, *holes = in_file
        polygon = OutlinePolygon(exterior=exterior, holes=tuple(holes))
        polygons.append(polygon)
    return tuple(polygons)


def _outline_ring(ring: NDArray[np.float64]) -> OutlineRing:
    return OutlineRing(points=image_points(ring))


def _fit_in_file(fit: Fit, grid: PixelGrid) -> Fit:
    """Convert the places of a fit from square pixels to pixels of the file."""
    if fit.center is None or grid.is_square:
        return fit
    in_square = [(point.x_px, point.y_px) for point in (fit.center, *fit.corners)]
    in_file = grid.to_file(in_square)
    center, *corners = image_points(in_file)
    return fit.model_copy(update={"center": center, "corners": tuple(corners)})


def _frame_area(
    frame: Frame,
    grid: PixelGrid,
    *,
    gsd: float | None,
    box: BoundingBox | None,
    fit: Fit | None,
) -> FrameArea | None:
    """Convert scale and places to the caller's resized copy; None without a copy."""
    if frame.size is None:
        return None
    width, height = frame.size
    across = width / grid.width_px
    down = height / grid.height_px
    side_px = CoordinateFrame(frame, grid).side_of_copy_px
    fit_center = None
    fit_corners: tuple[ImagePoint, ...] = ()
    if fit is not None and fit.center is not None:
        fit_center = fit.center.scaled(across, down)
        fit_corners = tuple(corner.scaled(across, down) for corner in fit.corners)
    return FrameArea(
        width_px=width,
        height_px=height,
        gsd_m_per_px=None if gsd is None else gsd * side_px,
        bounding_box=None if box is None else box.scaled(across, down),
        fit_center=fit_center,
        fit_corners=fit_corners,
    )
