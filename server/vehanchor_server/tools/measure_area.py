"""The tool ``measure_area``: measure the areas of objects. Structured as ``estimate_gsd``."""

# No postponed annotations here: the SDK reads the result's schema from them.

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

from mcp.server.apps import client_supports_apps
from mcp.server.mcpserver import Context
from mcp.types import CallToolResult
from pydantic import Field

from vehanchor.records import AreaMeasurement, BoundingBox, OtherObject
from vehanchor.scale.defaults import USABLE_CHANCE
from vehanchor_server.app_page import APP_META
from vehanchor_server.calls.call import run_call
from vehanchor_server.calls.compact import ADVICE_ON_MASK
from vehanchor_server.calls.job import Job
from vehanchor_server.calls.reply import Detail, PictureRequest, Reply
from vehanchor_server.calls.task import work
from vehanchor_server.errors import CallError
from vehanchor_server.images.argument import ImageArgument
from vehanchor_server.images.source import OpenedImage
from vehanchor_server.services import Services
from vehanchor_server.tools.measuring import (
    OVERLAY_SIDE_PX,
    OverlayArgument,
    OverlaySideArgument,
    ScaleArguments,
    copy_hint,
)
from vehanchor_server.tools.messages import (
    STATUS_RULES,
    interval,
    no_scale_message,
    numbered,
    rounded,
    scale_origin,
    unusable_scale,
    warnings_of,
)
from vehanchor_server.tools.portable_schema import Listing
from vehanchor_server.tools.scale_question import (
    UNLISTED_ARGUMENTS,
    AddArgument,
    CoordinatesArgument,
    DetailArgument,
    DropArgument,
    FocalLengthArgument,
    FrameArgument,
    GsdArgument,
    GsdBasisArgument,
    GsdToleranceArgument,
    HeightArgument,
    HeightBasisArgument,
    HeightToleranceArgument,
    KnownLengthsArgument,
    ObjectHeightArgument,
    ReferenceLengthArgument,
    RegionArgument,
    ScaleQuestion,
    stated_scale,
)
from vehanchor_server.tools.strict_tool import StrictTool
from vehanchor_server.tools.target import MAX_TARGETS, Target

if TYPE_CHECKING:
    from vehanchor.segmentation.prompt import Prompt

_DESCRIPTION = (
    "Measures the area (square metres) and size of objects in a near-nadir aerial or satellite image: roof, pool, "
    "field, landing site. Give a tight box around each whole object; never estimate an area by eye. Also "
    f"returns length, width, and inscribed_diameter_m, the largest circle inside, for landings. {STATUS_RULES}"
)


_EXAMPLE = [{"box": {"x_min": 255, "y_min": 160, "x_max": 535, "y_max": 470}}]


@dataclass(frozen=True)
class _Question:
    """Targets and scale arguments of a call."""

    targets: tuple[Target, ...]
    scale: ScaleArguments
    wanted: PictureRequest


def measure_area_tool(services: Services) -> StrictTool:
    """Create the tool for a server."""

    async def measure_area(
        image: ImageArgument,
        ctx: Context[Any, Any],
        target: Annotated[Target | None, Field(description="The object: box or points.", examples=_EXAMPLE)] = None,
        targets: Annotated[
            tuple[Target, ...] | None,
            Field(min_length=1, max_length=MAX_TARGETS, description="Box or points of each.", examples=[_EXAMPLE]),
        ] = None,
        coordinates: CoordinatesArgument = "pixels",
        frame: FrameArgument = None,
        gsd_m_per_px: GsdArgument = None,
        gsd_basis: GsdBasisArgument = "assumed",
        gsd_tolerance: GsdToleranceArgument = None,
        region: RegionArgument = None,
        reference_length_m: ReferenceLengthArgument = None,
        known_lengths: KnownLengthsArgument = None,
        height_m: HeightArgument = None,
        focal_35mm: FocalLengthArgument = None,
        height_basis: HeightBasisArgument = "assumed",
        height_tolerance_m: HeightToleranceArgument = None,
        object_height_m: ObjectHeightArgument = None,
        drop: DropArgument = None,
        add: AddArgument = None,
        include_overlay: OverlayArgument = False,
        overlay_side_px: OverlaySideArgument = OVERLAY_SIDE_PX,
        detail: DetailArgument = "short",
    ) -> Annotated[CallToolResult, AreaMeasurement]:
        height = (height_m, height_basis, height_tolerance_m, focal_35mm)
        stated = stated_scale(gsd_m_per_px, gsd_basis, gsd_tolerance)
        facts = (region, reference_length_m, frame, known_lengths, *height, coordinates)
        question = ScaleQuestion(*facts, drop=drop, add=add, stated=stated)
        paged = client_supports_apps(ctx)
        wanted = PictureRequest(include_overlay, paged, overlay_side_px)
        by = ScaleArguments(question, object_height_m)
        asked = _Question(_merge_targets(target, targets), by, wanted)
        answer = await run_call(services, ctx, image, _measure, asked)
        words = [
            numbered([_area_of_object(record) for record in answer.records]),
            *warnings_of(answer.records, detail),
            *copy_hint(_places(asked.targets), question, *_size(answer.record)),
        ]
        return answer.to_result(" ".join(words), detail=detail, paged=paged)

    return StrictTool.read_only(
        measure_area,
        title="Measure the areas of objects in an aerial image",
        description=_DESCRIPTION,
        meta=APP_META,
        answered=("status", "area_m2", "confidence", "inscribed_diameter_m"),
        required=("targets",),
        listing=Listing(("target", *UNLISTED_ARGUMENTS), services.settings.image_kinds),
    )


def _merge_targets(target: Target | None, targets: tuple[Target, ...] | None) -> tuple[Target, ...]:
    if (target is None) == (targets is None):
        problem = "target and targets are both given: give targets" if target else "targets: it is required"
        raise CallError("invalid_arguments", f"{problem}. Example: {json.dumps({'targets': _EXAMPLE})}")
    return (target,) if target is not None else targets or ()


def _places(targets: Iterable[Target]) -> Iterator[tuple[float, float]]:
    for target in targets:
        if target.box is not None:
            yield target.box.x_max, target.box.y_max
        for point in target.points or ():
            yield point.x, point.y


def _size(record: AreaMeasurement) -> tuple[int, int]:
    return record.image_width_px, record.image_height_px


@work(AreaMeasurement)
def _measure(services: Services, job: Job, source: OpenedImage, question: _Question) -> Reply[AreaMeasurement]:
    """Segment the objects and measure them, in a worker process or thread.

    Raises:
        VehAnchorError: the library refused the image or an option.
        CallError: a model cannot be loaded.
        CallStoppedError: the call was stopped.
    """
    from vehanchor.imagery.sources.opening import open_raster
    from vehanchor.measure.area import analyse_objects
    from vehanchor.pictures.area import cut_to_objects, draw_area
    from vehanchor_server.app_page.panel import drawing_of
    from vehanchor_server.calls.overlay import draw_pictures

    prompts = [_prompt(target) for target in question.targets]  # refuse invalid prompts before the work
    segmenter = services.models.segmenter(job.runtime)
    options, scale = question.scale.resolve(services, job)
    job.stop.check()
    with open_raster(source, limits=options.reading.limits) as raster:
        job.segmenting()
        found = analyse_objects(
            raster,
            prompts,
            segmenter,
            scale,
            options,
            object_height_m=question.scale.object_height_m,
        )
        first = found[0]
        cut = cut_to_objects(found, question.wanted.long_side_px)
        pictures = draw_pictures(raster, job, question.wanted, lambda seen: draw_area(seen, *found, cut=cut), cut.part)
    drawing = drawing_of(first.scale) if question.wanted.page and first.scale is not None else None
    measured = tuple(each.measurement for each in found)
    return Reply(measured, pictures.overlay, pictures.page, drawing)


def _prompt(target: Target) -> "Prompt":
    from vehanchor.segmentation.prompt import read_prompt

    if target.box is not None:
        box = target.box
        return read_prompt((box.x_min, box.y_min, box.x_max, box.y_max), None)
    return read_prompt(None, [(point.x, point.y, point.label == "include") for point in target.points or ()])


def describe_area(area: AreaMeasurement, detail: Detail = "full") -> str:
    """Describe the area and its status, the position of the mask, and each warning, in one sentence each."""
    return " ".join([_area_of_object(area), *warnings_of([area], detail)])


def _area_of_object(area: AreaMeasurement) -> str:
    box = area.bounding_box if area.frame is None else area.frame.bounding_box
    if box is None:
        return _area_in_words(area)
    seen = "image" if area.frame is None else f"{area.frame.width_px} x {area.frame.height_px} copy"
    others = [_other_in_words(area, other) for other in area.alternatives]
    instead = f" Or you mean {' or '.join(others)}: give the box of the right one." if others else ""
    return f"{_area_in_words(area)} The mask spans {_span(box)} px of your {seen}.{instead}"


def _other_in_words(area: AreaMeasurement, other: OtherObject) -> str:
    size = f"{other.mask_area_px} px" if other.area_m2 is None else f"{rounded(other.area_m2)} m2"
    box, frame = other.bounding_box, area.frame
    if frame is not None:
        box = box.scaled(frame.width_px / area.image_width_px, frame.height_px / area.image_height_px)
    return f"{size} in {_span(box)}"


def _span(box: BoundingBox) -> str:
    return f"x {box.x1_px:.0f} to {box.x2_px:.0f}, y {box.y1_px:.0f} to {box.y2_px:.0f}"


def _area_in_words(area: AreaMeasurement) -> str:
    if not area.mask_area_px:
        return "No object found: no area. Draw a tight box around a visible object."
    if area.area_m2 is None:
        return f"No area: the object covers {area.mask_area_px} px, but {no_scale_message(area.estimate)}."
    size = f"{rounded(area.area_m2)} m2{interval(area.area_ci95_low_m2, area.area_ci95_high_m2)}"
    if area.length_m is not None and area.width_m is not None and area.inscribed_diameter_m is not None:
        size += f", {rounded(area.length_m)} x {rounded(area.width_m)} m"
        size += f", largest circle inside {rounded(area.inscribed_diameter_m)} m across"
    size += f"; {scale_origin(area)}: "
    if area.status == "ok":
        return size + "safe to use."
    if area.confidence is not None and area.confidence < USABLE_CHANCE:
        return size + unusable_scale(area.estimate)
    if any(notice.code == "mask_score_low" for notice in area.warnings):
        return size + "do not rely on it (low mask score); look at include_overlay, or draw another box."
    return size + f"do not rely on it (a point does not show the whole object); {ADVICE_ON_MASK}."
