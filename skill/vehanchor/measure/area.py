"""Area of one object in a box or at points.

Raster + prompt -> mask -> pixels x GSD^2 -> record. The scale comes from the whole image, or from
the caller. No language model takes part in the measurement.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.analysis.measurement_analysis import AreaAnalysis
from vehanchor.measure.scale_source import find_measurement_scale
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
from vehanchor.segmentation.doubts import mask_notices
from vehanchor.segmentation.prompt import prompt_in_image
from vehanchor.segmentation.segmenter import Segmenter
from vehanchor.segmentation.shape import inscribed_circle, perimeter, rotated_extents, trace_outline

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster
    from vehanchor.measure.scale_source import MeasurementScale, ScaleInput
    from vehanchor.options import Frame
    from vehanchor.options.pixel_grid import PixelGrid
    from vehanchor.scale.lengths import Spread
    from vehanchor.segmentation.prompt import Prompt
    from vehanchor.segmentation.segmenter import Segmentation, SegmenterCard
    from vehanchor.segmentation.shape import Mask


def analyse_objects(
    raster: Raster,
    prompts: Sequence[Prompt],
    segmenter: Segmenter,
    scale: ScaleInput,
    options: ScaleOptions,
    *,
    object_height_m: float | None = None,
) -> tuple[AreaAnalysis, ...]:
    """Measure several objects of an open image with one search.

    Args:
        raster: the image.
        prompts: results of ``read_prompt``, in the caller's coordinates.
        segmenter: segments the objects.
        scale: the known scale, or the analysis that finds it.
        options: all options of the scale estimate.
        object_height_m: height of all objects above the ground.

    Returns:
        For each prompt the record, the mask, the prompt in pixels of the image and the analysis of
        the scale.

    Raises:
        VehAnchorError: see ``Engine.measure_area``.
    """
    options.frame.check(raster.grid)
    in_image = [prompt_in_image(prompt, options.frame, raster.grid) for prompt in prompts]
    # Masks first: they are faster than the search, and an invalid prompt fails early.
    limits = options.reading.limits
    masks = [segmenter.segment(raster, prompt, limits=limits) for prompt in in_image]
    measurement_scale = find_measurement_scale(
        raster, scale, options, object_height_m=object_height_m
    )
    analyses = []
    for prompt, mask in zip(in_image, masks, strict=True):
        record = _measure_object(
            raster,
            mask,
            prompt=prompt,
            card=segmenter.card,
            options=options,
            scale=measurement_scale,
        )
        analysis = AreaAnalysis(
            record,
            mask,
            prompt,
            scale=measurement_scale.analysis,
            nadir=measurement_scale.plane is None,
            grid=raster.grid,
        )
        analyses.append(analysis)
    return tuple(analyses)


def _measure_object(
    raster: Raster,
    segmentation: Segmentation,
    *,
    prompt: Prompt,
    card: SegmenterCard,
    options: ScaleOptions,
    scale: MeasurementScale,
) -> AreaMeasurement:
    """Make the record from mask and scale."""
    mask = segmentation.mask
    left = segmentation.window.x_px
    top = segmentation.window.y_px
    n_px = int(mask.sum())
    perimeter_px = perimeter(mask)
    length_px, width_px = rotated_extents(mask)
    circle = inscribed_circle(mask)
    # None for an empty mask, too: it has no size, not a size of zero.
    gsd = scale.gsd_over(mask, left, top)
    area = _NO_SIZE
    diameter = _NO_SIZE
    centre = None
    if circle is not None:
        centre_px = (circle.x + left, circle.y + top)
        x_px, y_px = raster.grid.to_file(centre_px).tolist()
        centre = ImagePoint(x_px=x_px, y_px=y_px)
    if gsd is not None and circle is not None:
        area_log_sd = card.area_log_sd(prompt, segmentation)
        # The paper, section III-G: the area is the number of pixels times the scale squared, so
        # the log error of the scale counts twice.
        area_spread = scale.spread.times(2).plus(area_log_sd)
        area = _Size.of(n_px * gsd**2, area_spread)
        diameter_log_sd = _diameter_log_sd(
            area_log_sd,
            n_px,
            perimeter_px=perimeter_px,
            diameter_px=circle.diameter,
        )
        diameter_spread = scale.spread.plus(diameter_log_sd)
        diameter = _Size.of(circle.diameter * gsd, diameter_spread)
    mode_length_px = None
    if scale.estimate is not None:
        mode_length_px = scale.estimate.mode_length_px
    status = scale.status
    if status == "ok" and card.is_doubtful(segmentation):
        status = "low_confidence"
    box = _box(segmentation, raster.grid)
    doubts = mask_notices(raster, segmentation, prompt=prompt, card=card, width_px=width_px)
    alternatives = [_other_object(other, scale, raster.grid) for other in segmentation.alternatives]
    return AreaMeasurement(
        status=status,
        area_m2=area.value,
        area_ci95_low_m2=area.low,
        area_ci95_high_m2=area.high,
        mode_length_px=mode_length_px,
        mask_area_px=n_px,
        mask_score=segmentation.score,
        perimeter_m=_metres(perimeter_px, gsd),
        length_m=_metres(length_px, gsd),
        width_m=_metres(width_px, gsd),
        inscribed_diameter_m=diameter.value,
        inscribed_diameter_ci95_low_m=diameter.low,
        inscribed_diameter_ci95_high_m=diameter.high,
        inscribed_center=centre,
        bounding_box=box,
        alternatives=tuple(alternatives),
        outline=_outline(mask, left, top=top, grid=raster.grid),
        frame=_frame_area(options.frame, raster.grid, gsd=scale.gsd_m_per_px, box=box),
        segmenter=card.name,
        segmenter_sha256=card.sha256,
        warnings=(*scale.notices, *doubts),
        **scale.fields(raster.grid),
    )


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


def _box(segmentation: Segmentation, grid: PixelGrid) -> BoundingBox | None:
    """Return the box of a mask in pixels of the file; None for an empty mask."""
    bounds = segmentation.bounding_box
    if bounds is None:
        return None
    corners = np.reshape(bounds, (2, 2))
    x1, y1, x2, y2 = grid.to_file(corners).ravel().tolist()
    return BoundingBox(x1_px=x1, y1_px=y1, x2_px=x2, y2_px=y2)


def _outline(mask: Mask, left: int, *, top: int, grid: PixelGrid) -> tuple[OutlinePolygon, ...]:
    """Trace the outline of a mask in pixels of the file.

    Args:
        mask: ``[h, w]`` square pixels.
        left: column of its first pixel in the image.
        top: row of its first pixel in the image.
        grid: pixels of the image.
    """
    polygons = []
    for rings in trace_outline(mask):
        in_image = [np.add(ring, (left, top)) for ring in rings]
        exterior, *holes = [_outline_ring(grid.to_file(ring)) for ring in in_image]
        polygon = OutlinePolygon(exterior=exterior, holes=tuple(holes))
        polygons.append(polygon)
    return tuple(polygons)


def _outline_ring(ring: NDArray[np.float64]) -> OutlineRing:
    points = [ImagePoint(x_px=x, y_px=y) for x, y in ring.tolist()]
    return OutlineRing(points=tuple(points))


def _frame_area(
    frame: Frame, grid: PixelGrid, *, gsd: float | None, box: BoundingBox | None
) -> FrameArea | None:
    """Convert scale and bounding box to the caller's resized copy; None without a copy."""
    if frame.size is None:
        return None
    width, height = frame.size
    across = width / grid.width_px
    down = height / grid.height_px
    side_px = CoordinateFrame(frame, grid).side_of_copy_px
    return FrameArea(
        width_px=width,
        height_px=height,
        gsd_m_per_px=None if gsd is None else gsd * side_px,
        bounding_box=None if box is None else box.scaled(across, down),
    )
