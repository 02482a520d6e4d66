"""The tool that measures an object's area: its arguments, its work, its answer in words; as in ``estimate_gsd``."""

# Annotations are evaluated here on purpose: the SDK reads the result's schema from them.

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

from mcp.server.apps import client_supports_apps
from mcp.server.mcpserver import Context
from mcp.types import CallToolResult
from pydantic import Field

from vehanchor.records import AreaMeasurement, Notice
from vehanchor.scale.thresholds import FALLBACK_CONFIDENCE
from vehanchor_server.app_page import APP_META
from vehanchor_server.calls.answer import Answer, Detail, WantedPictures
from vehanchor_server.calls.call import run_call
from vehanchor_server.calls.job import Job
from vehanchor_server.errors import CallError
from vehanchor_server.frozen import Flag
from vehanchor_server.images.argument import ImageArgument
from vehanchor_server.images.source import OpenedImage
from vehanchor_server.services import Services
from vehanchor_server.tools.measuring import MeasuredBy, copy_hint
from vehanchor_server.tools.messages import (
    OBEY,
    interval,
    not_to_be_used,
    nothing_found,
    numbered,
    rounded,
    scale_origin,
    warnings,
)
from vehanchor_server.tools.scale_question import (
    UNLISTED_ARGUMENTS,
    CoordinatesArgument,
    DetailArgument,
    FocalLengthArgument,
    FrameArgument,
    GsdArgument,
    HeightArgument,
    KnownLengthsArgument,
    KnownScaleArgument,
    ObjectHeightArgument,
    ReferenceLengthArgument,
    RegionArgument,
    ScaleQuestion,
)
from vehanchor_server.tools.strict_tool import StrictTool
from vehanchor_server.tools.target import MAX_TARGETS, Target

if TYPE_CHECKING:
    from vehanchor.segmentation.prompt import Prompt

_DESCRIPTION = (
    "Measures the real area (square metres) and size of objects in a near-nadir aerial or satellite image: roof, pool, "
    "field, clearing, car park, landing site. Each is segmented from a box or points that you give; prefer a box, "
    "drawn tightly around the whole object. Call it instead of judging an area by eye or multiplying a box's sides. "
    "Also gives length, width, and inscribed_diameter_m, the largest circle that fits inside: what a landing needs. "
    f"{OBEY}"
)


@dataclass(frozen=True)
class _Question:
    """A caller's words about the areas it asks for."""

    targets: tuple[Target, ...]
    by: MeasuredBy


def measure_area_tool(services: Services) -> StrictTool:
    """The tool for a server."""

    async def measure_area(
        image: ImageArgument,
        ctx: Context[Any, Any],
        target: Annotated[Target | None, Field(description="The object: box or points.")] = None,
        targets: Annotated[
            tuple[Target, ...] | None,
            Field(min_length=1, max_length=MAX_TARGETS, description="Box or points of each object, up to 16."),
        ] = None,
        coordinates: CoordinatesArgument = "pixels",
        frame: FrameArgument = None,
        scale: KnownScaleArgument = None,
        gsd_m_per_px: GsdArgument = None,
        region: RegionArgument = None,
        reference_length_m: ReferenceLengthArgument = None,
        known_lengths: KnownLengthsArgument = None,
        height_m: HeightArgument = None,
        focal_35mm: FocalLengthArgument = None,
        object_height_m: ObjectHeightArgument = None,
        include_overlay: Annotated[
            Flag, Field(description="Also return a picture with the first object's outline.")
        ] = False,
        detail: DetailArgument = "short",
    ) -> Annotated[CallToolResult, AreaMeasurement]:
        question = ScaleQuestion(region, reference_length_m, frame, known_lengths, height_m, focal_35mm, coordinates)
        asked = _Question(_named(target, targets), MeasuredBy(gsd_m_per_px, scale, question, object_height_m))
        paged = client_supports_apps(ctx)
        wanted = WantedPictures(include_overlay, paged)
        answer = await run_call(services, ctx, image, partial(_measure, question=asked, wanted=wanted))
        first = answer.record
        words = [
            numbered([_area_of_object(record) for record in answer.records]),
            *warnings(_once(answer.records), detail),
            *copy_hint(_places(asked.targets), question, first.image_width_px, first.image_height_px),
        ]
        return answer.to_result(" ".join(words), detail=detail, paged=paged)

    return StrictTool.read_only(
        measure_area,
        title="Measure the areas of objects in an aerial image",
        description=_DESCRIPTION,
        meta=APP_META,
        answered=("status", "area_m2", "confidence", "inscribed_diameter_m"),
        required=("targets",),
        unlisted=("target", *UNLISTED_ARGUMENTS),
    )


def _named(target: Target | None, targets: tuple[Target, ...] | None) -> tuple[Target, ...]:
    if (target is None) == (targets is None):
        problem = "target and targets are both given: give one of the two" if target else "targets: it is required"
        raise CallError("invalid_arguments", f"{problem}.")
    return (target,) if target is not None else targets or ()


def _places(targets: Iterable[Target]) -> Iterator[tuple[float, float]]:
    for target in targets:
        if target.box is not None:
            yield target.box.x_max, target.box.y_max
        for point in target.points or ():
            yield point.x, point.y


def _once(records: Sequence[AreaMeasurement]) -> list[Notice]:
    """The warnings of all, those of the scale once."""
    return list(dict.fromkeys(notice for record in records for notice in record.warnings))


def _measure(
    services: Services, job: Job, source: OpenedImage, question: _Question, wanted: WantedPictures
) -> Answer[AreaMeasurement]:
    """Segment the object and measure it; in a worker's process or thread.

    Raises:
        VehAnchorError: the library refused.
        CallError: a model cannot be loaded.
        CallStoppedError: the call was asked to end.
    """
    from vehanchor.imagery.sources.opening import open_raster
    from vehanchor.measure.area import analyse_objects
    from vehanchor.pictures.area import draw_area
    from vehanchor_server.app_page.panel import drawing_of, length_histogram
    from vehanchor_server.calls.overlay import draw_pictures

    prompts = [_prompt(target) for target in question.targets]  # what has no meaning is told before the work
    segmenter = services.models.segmenter()
    options, scale = question.by.resolve(services)
    job.enter("decode")
    with open_raster(source, limits=options.reading.limits) as raster:
        job.segmenting()
        found = analyse_objects(
            raster,
            prompts,
            segmenter,
            scale,
            options,
            object_height_m=question.by.object_height_m,
            progress=job.searched,
            run_options=job.run_options,
        )
        first = found[0]
        pictures = draw_pictures(raster, job, wanted, lambda seen: draw_area(seen, first))
    histogram = None if first.scale is None else length_histogram(first.scale)
    drawing = drawing_of(first.scale) if wanted.page and first.scale is not None else None
    measured = tuple(each.measurement for each in found)
    return Answer(measured, pictures.overlay, histogram, pictures.page, drawing)


def _prompt(target: Target) -> "Prompt":
    from vehanchor.segmentation.prompt import read_prompt

    if target.box is not None:
        box = target.box
        return read_prompt((box.x_min, box.y_min, box.x_max, box.y_max), None)
    return read_prompt(None, [(point.x, point.y, point.label == "include") for point in target.points or ()])


def describe_area(area: AreaMeasurement, detail: Detail = "full") -> str:
    """One sentence with the area and whether to use it, one where the object lies, and one for each warning."""
    return " ".join([_area_of_object(area), *warnings(area.warnings, detail)])


def _area_of_object(area: AreaMeasurement) -> str:
    box = area.bounding_box if area.frame is None else area.frame.bounding_box
    if box is None:
        return _area_in_words(area)
    seen = "image" if area.frame is None else f"{area.frame.width_px} x {area.frame.height_px} copy"
    return (
        f"{_area_in_words(area)} The mask spans x {box.x1_px:.0f} to {box.x2_px:.0f}, y {box.y1_px:.0f} to "
        f"{box.y2_px:.0f} px of your {seen}."
    )


def _area_in_words(area: AreaMeasurement) -> str:
    if not area.mask_area_px:
        return "No object found there: no area. Draw a box tightly around one that can be seen."
    if area.area_m2 is None:
        return (
            f"No area: the object covers {area.mask_area_px} px, but {nothing_found(area.estimate)}, and give its "
            "scale as gsd_m_per_px."
        )
    size = f"{rounded(area.area_m2)} m2{interval(area.area_ci95_low_m2, area.area_ci95_high_m2)}"
    if area.length_m is not None and area.width_m is not None and area.inscribed_diameter_m is not None:
        size += f", {rounded(area.length_m)} x {rounded(area.width_m)} m"
        size += f", largest circle inside {rounded(area.inscribed_diameter_m)} m across"
    size += f"; {scale_origin(area)}: "
    if area.status == "ok":
        return size + ("as good as the given scale." if area.scale_source == "given" else "safe to use.")
    if area.confidence is not None and area.confidence < FALLBACK_CONFIDENCE:
        return size + not_to_be_used(area.estimate)
    return size + "do not rely on it (the segmenter doubts its mask); look at the overlay, or draw another box."
