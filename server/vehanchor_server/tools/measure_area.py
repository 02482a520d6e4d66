"""The tool that measures an object's area: its arguments, its work, its answer in words; as in ``estimate_gsd``."""

# Annotations are evaluated here on purpose: the SDK reads the result's schema from them.

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

from mcp.server.apps import client_supports_apps
from mcp.server.mcpserver import Context
from mcp.types import CallToolResult
from pydantic import Field

from vehanchor.records import AreaMeasurement
from vehanchor_server.app_page import APP_META
from vehanchor_server.calls.answer import Answer
from vehanchor_server.calls.call import run_call
from vehanchor_server.calls.job import Job
from vehanchor_server.images.argument import ImageArgument
from vehanchor_server.images.source import OpenedImage
from vehanchor_server.services import Services
from vehanchor_server.tools.scale_question import (
    FocalLengthArgument,
    FrameArgument,
    HeightArgument,
    KnownLengthsArgument,
    ReferenceLengthArgument,
    RegionArgument,
    ScaleQuestion,
)
from vehanchor_server.tools.sentences import POLICY, interval, not_to_be_used, rounded, sources, warnings
from vehanchor_server.tools.strict_tool import StrictTool
from vehanchor_server.tools.target import AnyTarget, BoxTarget, TargetArgument

if TYPE_CHECKING:
    from vehanchor.segmentation.segmenter import Prompt

__all__ = ["describe_area", "measure_area_tool"]

_DESCRIPTION = (
    "Measures the real area (square metres) and size of one object in a near-nadir aerial or satellite image: roof, "
    "pool, field, clearing, car park, landing site. The object is segmented from a box or points that you give; the "
    "scale comes from the cars in the image, a line of known length or the camera's height, or from gsd_m_per_px if "
    "you know it. Call it instead of judging an area "
    "by eye or multiplying a box's sides; prefer a box, drawn tightly around the whole object. Also returns length, "
    "width, perimeter, and inscribed_diameter_m, the largest circle that fits inside: what a landing needs. "
    f"{POLICY} The same rule holds for areas: status low_confidence means do not act on it, no_anchor means that there "
    "is no area, only pixels. If you see a resized copy of the image, give the copy's size as frame, and box and "
    "points in its pixels. Very large images take up to a minute."
)


@dataclass(frozen=True)
class _Question:
    """A caller's words about the area it asks for.

    Attributes:
        target: the object.
        gsd_m_per_px: the scale where the caller knows it.
        scale: how the scale is found where it does not.
    """

    target: AnyTarget
    gsd_m_per_px: float | None
    scale: ScaleQuestion


def measure_area_tool(services: Services) -> StrictTool:
    """The tool for a server."""

    async def measure_area(
        image: ImageArgument,
        target: Annotated[
            TargetArgument,
            Field(description="The object, in pixels of the image, or of frame where that is given: box or points."),
        ],
        ctx: Context[Any, Any],
        gsd_m_per_px: Annotated[
            float | None,
            Field(
                gt=0,
                le=1000,
                allow_inf_nan=False,
                description="Metres per pixel of the full image, if known: then no cars are needed.",
            ),
        ] = None,
        region: RegionArgument = None,
        reference_length_m: ReferenceLengthArgument = None,
        frame: FrameArgument = None,
        known_lengths: KnownLengthsArgument = None,
        height_m: HeightArgument = None,
        focal_35mm: FocalLengthArgument = None,
        include_overlay: Annotated[
            bool, Field(description="Also return a picture with the object's outline, the vehicles and a scale bar.")
        ] = False,
    ) -> Annotated[CallToolResult, AreaMeasurement]:
        scale = ScaleQuestion(region, reference_length_m, frame, known_lengths, height_m, focal_35mm)
        question = _Question(target, gsd_m_per_px, scale)
        drawn = include_overlay or client_supports_apps(ctx)
        answer = await run_call(services, ctx, image, partial(_measure, question=question, drawn=drawn))
        return answer.to_result(describe_area(answer.record), include_overlay=include_overlay)

    return StrictTool.read_only(
        measure_area, title="Measure the area of an object in an aerial image", description=_DESCRIPTION, meta=APP_META
    )


def _measure(
    services: Services, job: Job, source: OpenedImage, question: _Question, drawn: bool
) -> Answer[AreaMeasurement]:
    """Segment the object and measure it; in a worker's process or thread.

    Raises:
        VehAnchorError: the library refused.
        CallError: a model cannot be loaded.
        CallStoppedError: the call was asked to end.
    """
    from vehanchor.estimate import open_detector
    from vehanchor.imagery.raster import open_raster
    from vehanchor.measure import analyse_objects
    from vehanchor.pictures.area import draw_area
    from vehanchor_server.app_page.panel import length_histogram
    from vehanchor_server.calls.overlay import overlay_jpeg

    models = services.models
    prompt = _prompt(question.target)  # what has no meaning is told before the work
    known = question.gsd_m_per_px
    options = question.scale.options(services.settings, models if known is None else None)
    segmenter = models.segmenter()
    scale = known or open_detector(models.detector(), options)
    job.enter("decode")
    with open_raster(source, limits=options.reading.limits) as raster:
        job.segmenting()
        (analysis,) = analyse_objects(
            raster, [prompt], segmenter, scale, options, progress=job.searched, run_options=job.run_options
        )
        overlay = None
        if drawn:
            job.enter("overlay")
            overlay = overlay_jpeg(raster, job.stop, lambda seen: draw_area(seen, analysis))
    histogram = None if analysis.scale is None else length_histogram(analysis.scale)
    return Answer(analysis.measurement, overlay, histogram)


def _prompt(target: AnyTarget) -> "Prompt":
    from vehanchor.segmentation.prompt import read_prompt

    if isinstance(target, BoxTarget):
        box = target.box
        return read_prompt((box.x_min, box.y_min, box.x_max, box.y_max), None)
    return read_prompt(None, [(point.x, point.y, point.label == "include") for point in target.points])


def describe_area(area: AreaMeasurement) -> str:
    """One sentence with the area and whether to use it, one where the object lies, and one for each warning."""
    words = [_area_in_words(area)]
    box = area.bounding_box if area.frame is None else area.frame.bounding_box
    if box is not None:
        seen = "image" if area.frame is None else f"{area.frame.width_px} x {area.frame.height_px} copy"
        words.append(
            f"The mask spans x {box.x1_px:.0f} to {box.x2_px:.0f}, y {box.y1_px:.0f} to {box.y2_px:.0f} px of your "
            f"{seen}."
        )
    return " ".join([*words, *warnings(area.warnings)])


def _area_in_words(area: AreaMeasurement) -> str:
    if not area.mask_area_px:
        return "No object found there: no area. Draw a box tightly around one that can be seen."
    if area.area_m2 is None:
        return (
            f"The object covers {area.mask_area_px} px, but no vehicles were found, confidence 0: no metric scale, so "
            "no area; use another anchor, and give its scale as gsd_m_per_px."
        )
    size = f"{rounded(area.area_m2)} m2{interval(area.area_ci95_low_m2, area.area_ci95_high_m2)}"
    if area.length_m is not None and area.width_m is not None and area.inscribed_diameter_m is not None:
        size += f", {rounded(area.length_m)} x {rounded(area.width_m)} m"
        size += f", largest circle inside {rounded(area.inscribed_diameter_m)} m across"
    size += f"; {_scale_origin(area)}: "
    if area.status == "ok":
        return size + ("as good as the given scale." if area.scale is None else "safe to use.")
    if area.scale is not None and area.scale.status != "ok":
        return size + not_to_be_used(area.scale)
    return size + "do not rely on it (the segmenter doubts its mask); look at the overlay, or draw another box."


def _scale_origin(area: AreaMeasurement) -> str:
    """Where the scale comes from."""
    assert area.gsd_m_per_px is not None
    scale = f"scale {rounded(area.gsd_m_per_px)} m/px"
    if area.confidence is None or area.scale is None:
        return f"{scale} as given"
    return f"{scale}, confidence {area.confidence:.2f} from {sources(area.scale)}"
