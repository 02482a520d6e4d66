"""Area of one object in a box or at points.

Raster + prompt -> mask -> pixels x GSD^2 -> record. The scale comes from the whole image, or from
the caller. No language model takes part in the measurement.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from vehanchor.analysis.measurement_analysis import AreaAnalysis
from vehanchor.measure.scale_source import find_measurement_scale
from vehanchor.options import ScaleOptions
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

    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster
    from vehanchor.measure.scale_source import MeasurementScale, ScaleInput
    from vehanchor.options import Frame
    from vehanchor.segmentation.prompt import Prompt
    from vehanchor.segmentation.segmenter import Segmentation, SegmenterCard


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
        segmenter: finds the objects.
        scale: the known scale, or the analysis that finds it.
        options: all options of the scale estimate.
        object_height_m: height of all objects above the ground.

    Returns:
        For each prompt the record, the mask, the prompt in pixels of the image and the analysis of
        the scale.

    Raises:
        VehAnchorError: as ``Engine.measure_area``.
    """
    options.frame.check(raster.width_px, raster.height_px)
    prompts = [
        prompt_in_image(each, options.frame, width_px=raster.width_px, height_px=raster.height_px)
        for each in prompts
    ]
    # Masks first: they are faster than the search, and an invalid prompt fails early.
    masks = [segmenter.segment(raster, prompt, limits=options.reading.limits) for prompt in prompts]
    found = find_measurement_scale(raster, scale, options, object_height_m=object_height_m)
    return tuple(
        AreaAnalysis(
            _conclude(raster, mask, prompt, segmenter.card, options, found),
            mask,
            prompt,
            scale=found.analysis,
            nadir=found.plane is None,
        )
        for prompt, mask in zip(prompts, masks, strict=True)
    )


def _conclude(
    raster: Raster,
    found: Segmentation,
    prompt: Prompt,
    card: SegmenterCard,
    options: ScaleOptions,
    scale: MeasurementScale,
) -> AreaMeasurement:
    """Make the record from mask and scale."""
    mask = found.mask
    left = found.window.x_px
    top = found.window.y_px
    circle = inscribed_circle(mask)
    n_px = int(mask.sum())
    outline_px = perimeter(mask)
    (length_px, width_px) = rotated_extents(mask)
    measured = scale.gsd_over(mask, left, top)  # an empty mask has no size, not a size of zero
    area = diameter = _Size()
    if measured is not None and circle is not None:
        # the paper, section III-G
        area_m2 = n_px * measured**2
        diameter_m = circle.diameter * measured
        area_sd = card.area_log_sd(prompt, found)
        diameter_sd = _diameter_log_sd(
            area_sd, n_px, perimeter_px=outline_px, diameter_px=circle.diameter
        )
        area = _Size(area_m2, *scale.spread.times(2).plus(area_sd).around(area_m2))
        diameter = _Size(diameter_m, *scale.spread.plus(diameter_sd).around(diameter_m))
    box = _box(found)
    return AreaMeasurement(
        status="low_confidence"
        if scale.status == "ok" and card.is_doubtful(found)
        else scale.status,
        area_m2=area.value,
        area_ci95_low_m2=area.low,
        area_ci95_high_m2=area.high,
        mode_length_px=None if scale.estimate is None else scale.estimate.mode_length_px,
        mask_area_px=n_px,
        mask_score=found.score,
        perimeter_m=measured and outline_px * measured,
        length_m=measured and length_px * measured,
        width_m=measured and width_px * measured,
        inscribed_diameter_m=diameter.value,
        inscribed_diameter_ci95_low_m=diameter.low,
        inscribed_diameter_ci95_high_m=diameter.high,
        inscribed_center=None
        if circle is None
        else ImagePoint(x_px=circle.x + left, y_px=circle.y + top),
        bounding_box=box,
        alternatives=tuple(_other_object(each, scale) for each in found.alternatives),
        outline=_outline(mask, left, top),
        frame=_frame(options.frame, raster, gsd=scale.gsd_m_per_px, box=box),
        segmenter=card.name,
        segmenter_sha256=card.sha256,
        warnings=(
            *scale.notices,
            *mask_notices(raster, found, prompt=prompt, card=card, width_px=width_px),
        ),
        **scale.fields(raster.width_px, raster.height_px),
    )


class _Size(NamedTuple):
    """Size in metres or square metres with its 95 % interval; None without a scale or a mask."""

    value: float | None = None
    low: float | None = None
    high: float | None = None


def _diameter_log_sd(
    area_log_sd: float, area_px: float, perimeter_px: float, diameter_px: float
) -> float:
    """Propagate the mask's uncertainty to the diameter of its inscribed circle.

    An offset d of the outline changes the area by d times the perimeter and the diameter by 2 d.
    The relative error of the diameter is half of the area's for a disc, and equal to it for a
    narrow strip.
    """
    return max(area_log_sd / 2, 2 * area_log_sd * area_px / (perimeter_px * diameter_px))


def _other_object(found: Segmentation, scale: MeasurementScale) -> OtherObject:
    n_px = int(found.mask.sum())
    box = _box(found)
    assert box is not None, "alternatives are not empty"
    gsd = scale.gsd_over(found.mask, found.window.x_px, found.window.y_px)
    return OtherObject(
        area_m2=gsd and n_px * gsd**2, mask_area_px=n_px, mask_score=found.score, bounding_box=box
    )


def _box(found: Segmentation) -> BoundingBox | None:
    box = found.bounding_box
    return box and BoundingBox(x1_px=box[0], y1_px=box[1], x2_px=box[2], y2_px=box[3])


def _outline(mask: NDArray[np.bool_], left: int, top: int) -> tuple[OutlinePolygon, ...]:
    def ring(points: NDArray[np.float64]) -> OutlineRing:
        return OutlineRing(
            points=tuple(ImagePoint(x_px=float(x) + left, y_px=float(y) + top) for x, y in points)
        )

    return tuple(
        OutlinePolygon(exterior=ring(around), holes=tuple(map(ring, holes)))
        for around, *holes in trace_outline(mask)
    )


def _frame(
    frame: Frame, raster: Raster, gsd: float | None, box: BoundingBox | None
) -> FrameArea | None:
    if frame.size is None:
        return None
    width, height = frame.size
    across = width / raster.width_px
    down = height / raster.height_px
    return FrameArea(
        width_px=width,
        height_px=height,
        gsd_m_per_px=None if gsd is None else gsd / across,
        bounding_box=box and box.scaled(across, down),
    )
