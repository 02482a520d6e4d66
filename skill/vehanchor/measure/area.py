"""Area of one object: an image and a box or points in, square metres out.

Raster + prompt -> mask -> pixels x GSD^2 -> record. The scale comes from the vehicles of the whole image, or from the
caller. No language model is ever asked for an area.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.analysis.measured import AreaAnalysis
from vehanchor.errors import InvalidParameterError
from vehanchor.imagery.sources.opening import can_be_read_again, open_raster
from vehanchor.measure.resolved_scale import choose_scale, interval_around, resolve_scale
from vehanchor.models.session import named_providers
from vehanchor.models.zoo import resolve_segmenter
from vehanchor.options import ScaleOptions
from vehanchor.records import (
    AreaMeasurement,
    BoundingBox,
    FrameArea,
    ImagePoint,
    OutlinePolygon,
    OutlineRing,
)
from vehanchor.scale.lengths import Interval
from vehanchor.segmentation.doubts import mask_notices
from vehanchor.segmentation.prompt import prompt_in_image, read_prompt
from vehanchor.segmentation.segmenter import Segmenter, load_segmenter
from vehanchor.segmentation.shape import (
    inscribed_circle,
    mask_bounds,
    outline_parts,
    perimeter,
    rotated_extents,
)

if TYPE_CHECKING:
    import os
    from collections.abc import Callable, Mapping, Sequence
    from typing import Any, TypeAlias, Unpack

    import numpy as np
    import onnxruntime
    from numpy.typing import NDArray

    from vehanchor.detection.detector import Detector
    from vehanchor.imagery.raster import Raster
    from vehanchor.imagery.sources.opening import ImageSource
    from vehanchor.measure.resolved_scale import ResolvedScale, ScaleInput
    from vehanchor.options import Frame, OptionKeywords
    from vehanchor.records import GsdEstimate, KnownScale, Status
    from vehanchor.segmentation.prompt import Box, Point, Prompt
    from vehanchor.segmentation.segmenter import Segmentation, SegmenterCard

    SegmenterSource: TypeAlias = Segmenter | tuple[str | os.PathLike[str], str | os.PathLike[str]]


def measure_area(
    image: ImageSource,
    *,
    box: Box | None = None,
    points: Sequence[Point] | None = None,
    gsd_m_per_px: float | None = None,
    scale: KnownScale | GsdEstimate | Mapping[str, Any] | None = None,
    object_height_m: float | None = None,
    segmenter: SegmenterSource | None = None,
    detector: Detector | str | os.PathLike[str] | None = None,
    threads: int | None = None,
    providers: Sequence[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
    **options: Unpack[OptionKeywords],
) -> AreaMeasurement:
    """Measure the area of the object in a box or at a point, ``A = N_px * GSD^2`` (paper, section III-G).

    Prompts are in pixels, the first spanning 0 to 1, of the copy that a frame names; or as ``coordinates`` says.

    Args:
        image: as in ``estimate_gsd``.
        box: x1, y1, x2, y2, a geometry of shapely, or supervision's ``Detections`` of one object; or give points.
        points: x, y and, optionally, whether the point is on the object (the default) or beside it.
        gsd_m_per_px: the scale, metres per pixel of the full image, where it is known: then no detector runs.
        scale: an earlier estimate of this image, or its ``scale``: then no detector runs, either, and its interval and
            confidence hold.
        object_height_m: how high it lies above the ground, as a roof does; None for on it.
        segmenter: encoder and decoder paths, or a loaded ``Segmenter``; default the bundled one.
        detector: as in ``estimate_gsd``.
        threads: as in ``estimate_gsd``, for both models.
        providers: as in ``estimate_gsd``, for both models.
        progress: called with (tiles done, tiles in all) while vehicles are searched.
        **options: as in ``estimate_gsd``; the frame is that of the prompt, too.

    Returns:
        The record; ``area_m2`` is None, never a guess, where there is no scale.

    Raises:
        PromptError: neither or both prompts, or one that names nothing in the image.
        ImageError: the image cannot be used; see ``vehanchor.errors`` for its kinds.
        ModelError: the segmenter or the detector cannot be used.
        InvalidParameterError: an option has no meaning.
        FrameError: the frame has another aspect ratio than the image.
        ScaleMismatchError: the scale was estimated from another image.
        CalibrationError: the calibration cannot be read, or was made for another detector.
    """
    return analyse_area(
        image,
        ScaleOptions.of(options),
        box=box,
        points=points,
        gsd_m_per_px=gsd_m_per_px,
        scale=scale,
        object_height_m=object_height_m,
        segmenter=segmenter,
        detector=detector,
        threads=threads,
        providers=providers,
        progress=progress,
    ).measurement


def analyse_area(
    image: ImageSource,
    options: ScaleOptions | None = None,
    *,
    box: Box | None = None,
    points: Sequence[Point] | None = None,
    gsd_m_per_px: float | None = None,
    scale: KnownScale | GsdEstimate | Mapping[str, Any] | None = None,
    object_height_m: float | None = None,
    segmenter: SegmenterSource | None = None,
    detector: Detector | str | os.PathLike[str] | None = None,
    threads: int | None = None,
    providers: Sequence[str] | None = None,
    progress: Callable[[int, int], None] | None = None,
    run_options: onnxruntime.RunOptions | None = None,
) -> AreaAnalysis:
    """As ``measure_area``, with the mask and the vehicles behind the number.

    Args:
        image: as in ``estimate_gsd``.
        options: every choice of the method of scale, the frame included; None for the defaults.
        box: as in ``measure_area``, as all that follow.
        points: either these or a box.
        gsd_m_per_px: a known scale.
        scale: one that was estimated before.
        object_height_m: above the ground.
        segmenter: encoder and decoder.
        detector: of vehicles.
        threads: CPU threads.
        providers: where models run.
        progress: of the search for vehicles.
        run_options: ONNX Runtime's, for a caller that may have to end a running model (``terminate``).

    Returns:
        The record, the mask, the prompt and the scale's analysis.

    Raises:
        VehAnchorError: as ``measure_area``.
    """
    chosen = options or ScaleOptions()
    prompt = read_prompt(box, points)
    segmenting = _open_segmenter(segmenter, threads, providers)
    source = choose_scale(gsd_m_per_px, scale, detector, chosen, threads=threads, providers=providers)
    with open_raster(image, bands=chosen.reading.bands, limits=chosen.reading.limits, bgr=chosen.reading.bgr) as raster:
        (analysis,) = analyse_objects(
            raster,
            [prompt],
            segmenting,
            source,
            chosen,
            object_height_m=object_height_m,
            progress=progress,
            run_options=run_options,
        )
    seen = image if can_be_read_again(image) else None
    return replace(analysis, image=seen, reading=chosen.reading, ground=raster.ground)


def analyse_objects(
    raster: Raster,
    prompts: Sequence[Prompt],
    segmenter: Segmenter,
    scale: ScaleInput,
    options: ScaleOptions,
    *,
    object_height_m: float | None = None,
    progress: Callable[[int, int], None] | None = None,
    run_options: onnxruntime.RunOptions | None = None,
) -> tuple[AreaAnalysis, ...]:
    """As ``analyse_area``, of several objects of an image that is open already: one search serves them all.

    Args:
        raster: the image.
        prompts: what ``read_prompt`` gave, in the caller's coordinates.
        segmenter: finds the objects.
        scale: what ``choose_scale`` gave.
        options: every choice of the method of scale.
        object_height_m: above the ground, of all of them.
        progress: of the search for vehicles.
        run_options: ONNX Runtime's.

    Returns:
        For each prompt the record, the mask, the prompt in the image's pixels and the scale's analysis.

    Raises:
        VehAnchorError: as ``measure_area``.
    """
    options.frame.check(raster.width_px, raster.height_px)
    prompts = [prompt_in_image(each, options.frame, raster.width_px, raster.height_px) for each in prompts]
    # The masks first: they are the quicker of the two to find out that a prompt cannot be read.
    limits = options.reading.limits
    masks = segmenter.segment_all(raster, prompts, limits=limits, run_options=run_options)
    found = resolve_scale(
        raster, scale, options, object_height_m=object_height_m, progress=progress, run_options=run_options
    )
    records = [
        _conclude(raster, mask, prompt, segmenter.card, options, found)
        for prompt, mask in zip(prompts, masks, strict=True)
    ]
    return tuple(
        AreaAnalysis(record, mask, prompt, scale=found.analysis, nadir=found.plane is None)
        for record, prompt, mask in zip(records, prompts, masks, strict=True)
    )


def _open_segmenter(
    segmenter: SegmenterSource | None, threads: int | None, providers: Sequence[str] | None
) -> Segmenter:
    if isinstance(segmenter, Segmenter):
        return segmenter
    files = None
    if segmenter is not None:
        if isinstance(segmenter, str) or len(segmenter) != 2:
            raise InvalidParameterError(f"segmenter is {segmenter!r}: give two paths, of its encoder and its decoder")
        files = Path(segmenter[0]), Path(segmenter[1])
    return load_segmenter(*resolve_segmenter(files), threads=threads, providers=named_providers(providers))


# --- The record ------------------------------------------------------------------------------------------------------


def _conclude(
    raster: Raster,
    found: Segmentation,
    prompt: Prompt,
    card: SegmenterCard,
    options: ScaleOptions,
    scale: ResolvedScale,
) -> AreaMeasurement:
    """Mask and scale to record."""
    mask, left, top = found.mask, found.window.x_px, found.window.y_px
    bounds, circle = mask_bounds(mask), inscribed_circle(mask)
    n_px = int(mask.sum())
    gsd, estimate = scale.gsd_m_per_px, scale.estimate
    outline_px, (length_px, width_px) = perimeter(mask), rotated_extents(mask)
    measured = scale.gsd_over(mask, left, top)  # an empty mask has no size, rather than a size of zero
    size = _Size()
    if measured is not None and circle is not None:
        size = _size(n_px, outline_px, circle.diameter, measured, scale.log_sd, card.mask_area_log_sd)
    box = None if bounds is None else _moved_box((bounds.x1, bounds.y1, bounds.x2, bounds.y2), left, top)
    return AreaMeasurement(
        status=_status(scale, found.score, card, n_px),
        area_m2=size.area_m2,
        area_ci95_low_m2=size.area_interval and size.area_interval.low,
        area_ci95_high_m2=size.area_interval and size.area_interval.high,
        confidence=scale.confidence,
        gsd_m_per_px=gsd,
        n_vehicles=None if estimate is None else estimate.n_vehicles,
        mode_length_px=None if estimate is None else estimate.mode_length_px,
        scale_source=scale.source,
        mask_area_px=n_px,
        mask_score=found.score,
        perimeter_m=measured and outline_px * measured,
        length_m=measured and length_px * measured,
        width_m=measured and width_px * measured,
        inscribed_diameter_m=size.diameter_m,
        inscribed_diameter_ci95_low_m=size.diameter_interval and size.diameter_interval.low,
        inscribed_diameter_ci95_high_m=size.diameter_interval and size.diameter_interval.high,
        inscribed_center=None if circle is None else ImagePoint(x_px=circle.x + left, y_px=circle.y + top),
        bounding_box=box,
        outline=_outline(mask, left, top),
        image_width_px=raster.width_px,
        image_height_px=raster.height_px,
        frame=_frame(options.frame, raster, gsd, box),
        scale=scale.known,
        estimate=estimate,
        segmenter=card.name,
        segmenter_sha256=card.sha256,
        warnings=(
            *scale.notices,
            *mask_notices(raster, found, prompt, card, width_px),
        ),
    )


class _Size(NamedTuple):
    """Area and inscribed circle in metres with their 95 % intervals; None without a scale or a mask."""

    area_m2: float | None = None
    area_interval: Interval | None = None
    diameter_m: float | None = None
    diameter_interval: Interval | None = None


def _size(
    n_px: int, outline_px: float, diameter_px: float, gsd: float, scale_log_sd: float, mask_log_sd: float
) -> _Size:
    """``A = N_px * GSD^2`` (paper, section III-G), and the largest circle inside."""
    area, diameter = n_px * gsd**2, diameter_px * gsd
    diameter_log_sd = _diameter_log_sd(mask_log_sd, n_px, outline_px, diameter_px)
    return _Size(
        area,
        _interval(area, math.hypot(2 * scale_log_sd, mask_log_sd)),
        diameter,
        _interval(diameter, math.hypot(scale_log_sd, diameter_log_sd)),
    )


def _status(scale: ResolvedScale, score: float, card: SegmenterCard, n_px: int) -> Status:
    if scale.status != "ok":
        return scale.status
    return "low_confidence" if score < card.min_score or n_px == 0 else "ok"


def _interval(value: float, log_sd: float) -> Interval:
    return Interval(*interval_around(value, log_sd))


def _diameter_log_sd(area_log_sd: float, area_px: float, perimeter_px: float, diameter_px: float) -> float:
    """What the mask's uncertainty means for the circle inside it.

    An outline that is off by d everywhere changes the area by d times the perimeter, and the diameter by 2 d: for a
    disc half of the area's relative error, for a narrow strip all of it.
    """
    return max(area_log_sd / 2, 2 * area_log_sd * area_px / (perimeter_px * diameter_px))


def _moved_box(corners: tuple[float, float, float, float], dx: float, dy: float) -> BoundingBox:
    x1, y1, x2, y2 = corners
    return BoundingBox(x1_px=x1 + dx, y1_px=y1 + dy, x2_px=x2 + dx, y2_px=y2 + dy)


def _outline(mask: NDArray[np.bool_], left: int, top: int) -> tuple[OutlinePolygon, ...]:
    def ring(points: NDArray[np.float64]) -> OutlineRing:
        return OutlineRing(points=tuple(ImagePoint(x_px=float(x) + left, y_px=float(y) + top) for x, y in points))

    return tuple(
        OutlinePolygon(exterior=ring(part.exterior), holes=tuple(ring(hole) for hole in part.holes))
        for part in outline_parts(mask)
    )


def _frame(frame: Frame, raster: Raster, gsd: float | None, box: BoundingBox | None) -> FrameArea | None:
    if frame.size is None:
        return None
    width, height = frame.size
    across, down = width / raster.width_px, height / raster.height_px
    return FrameArea(
        width_px=width,
        height_px=height,
        gsd_m_per_px=None if gsd is None else gsd / across,
        bounding_box=box
        and BoundingBox(
            x1_px=box.x1_px * across, y1_px=box.y1_px * down, x2_px=box.x2_px * across, y2_px=box.y2_px * down
        ),
    )
