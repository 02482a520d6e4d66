"""The tools: what a planner can ask, and what it is told about when to ask it."""

# Annotations are evaluated here on purpose: the SDK reads the result's schema from them.

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar

from mcp.server.apps import client_supports_apps
from mcp.server.mcpserver import Context, Image
from mcp.types import CallToolResult, TextContent, ToolAnnotations
from pydantic import Field

from vehanchor.records import AreaMeasurement, GsdEstimate
from vehanchor_server.app_page import APP_META, panel_meta
from vehanchor_server.images.argument import AnyImage, Frame, ImageArgument
from vehanchor_server.images.source import ImageSources, OpenedImage
from vehanchor_server.models import Models
from vehanchor_server.settings import Settings
from vehanchor_server.tools.answer import Answer
from vehanchor_server.tools.capacity import Capacity, Stop
from vehanchor_server.tools.estimation import ScaleQuestion, estimate
from vehanchor_server.tools.job import PERCENT_DONE, Job
from vehanchor_server.tools.measurement import AreaQuestion, measure
from vehanchor_server.tools.sentences import describe_area, describe_estimate
from vehanchor_server.tools.strict import StrictTool
from vehanchor_server.tools.target import TargetArgument

__all__ = ["Services", "estimate_gsd_tool", "measure_area_tool", "tools"]

Result = TypeVar("Result")

POLICY = (
    "Rule for planners: use the scale where confidence >= 0.5. Below 0.5 do not act on it: fall back to another anchor "
    "(known altitude, visual odometry, an object of known size). Confidence 0 means that no vehicle was found and "
    "there is no estimate: gsd_m_per_px is null, never a guess."
)

_ESTIMATE_GSD = (
    "Measures the metric scale (ground sampling distance, metres per pixel) of a near-nadir aerial or satellite image "
    "from the cars in it; no camera metadata is needed. Call it before any distance, length or area is derived from an "
    "aerial image whose scale is unknown or doubtful; never estimate the scale by eye. Needs visible cars and about "
    f"0.3 m/px or finer. {POLICY} Multiply pixel distances by gsd_m_per_px and pixel areas by its square. If you see a "
    "resized copy of the image, give the copy's size as frame and use frame.gsd_m_per_px for distances in that copy. "
    "Very large images take up to a minute."
)

_MEASURE_AREA = (
    "Measures the real area (square metres) and size of one object in a near-nadir aerial or satellite image: roof, "
    "pool, field, clearing, car park, landing site. The object is segmented from a box or points that you give; the "
    "scale comes from the cars in the image, or from gsd_m_per_px if you know it. Call it instead of judging an area "
    "by eye or multiplying a box's sides; prefer a box, drawn tightly around the whole object. Also returns length, "
    "width, perimeter, and inscribed_diameter_m, the largest circle that fits inside: what a landing needs. "
    f"{POLICY} The same rule holds for areas: status low_confidence means do not act on it, no_anchor means that there "
    "is no area, only pixels. If you see a resized copy of the image, give the copy's size as frame, and box and "
    "points in its pixels. Very large images take up to a minute."
)

# What both tools are asked.
_Image = Annotated[ImageArgument, Field(description="The whole image, uncropped; kind says where it is.")]
_Region = Annotated[
    str | None,
    Field(
        max_length=64,
        description="Where the image was taken, if known: europe or north_america; cars differ in length.",
    ),
]
_ReferenceLength = Annotated[
    float | None,
    Field(
        gt=0,
        le=100,
        allow_inf_nan=False,
        description="Typical car length there in metres, if better known; not with region.",
    ),
]
_FrameSize = Annotated[
    Frame | None, Field(description="Size of the resized copy that you see; its aspect ratio is the image's.")
]


@dataclass(frozen=True)
class Services:
    """What tools work with; one for each server.

    Attributes:
        settings: the operator's options.
        models: the operator's models.
        sources: where images come from.
        capacity: how much runs at once.
    """

    settings: Settings
    models: Models
    sources: ImageSources
    capacity: Capacity


def tools(services: Services) -> list[StrictTool]:
    """All tools of the server."""
    return [estimate_gsd_tool(services), measure_area_tool(services)]


def estimate_gsd_tool(services: Services) -> StrictTool:
    """The tool that measures an image's scale."""

    async def estimate_gsd(
        image: _Image,
        ctx: Context[Any, Any],
        region: _Region = None,
        reference_length_m: _ReferenceLength = None,
        frame: _FrameSize = None,
        include_overlay: Annotated[
            bool, Field(description="Also return a picture with the vehicles that were measured and a scale bar.")
        ] = False,
    ) -> Annotated[CallToolResult, GsdEstimate]:
        drawn = include_overlay or client_supports_apps(ctx)
        question = ScaleQuestion(region, reference_length_m, frame, drawn)

        def work(job: Job, source: OpenedImage) -> Answer[GsdEstimate]:
            return estimate(services.settings, services.models, job, source, question)

        answer = await _run(services, ctx, image, work)
        return _result(answer, describe_estimate(answer.record), include_overlay)

    return _looking_tool(estimate_gsd, "Measure the scale of an aerial image", _ESTIMATE_GSD)


def measure_area_tool(services: Services) -> StrictTool:
    """The tool that measures an object's area."""

    async def measure_area(
        image: _Image,
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
        region: _Region = None,
        reference_length_m: _ReferenceLength = None,
        frame: _FrameSize = None,
        include_overlay: Annotated[
            bool, Field(description="Also return a picture with the object's outline, the vehicles and a scale bar.")
        ] = False,
    ) -> Annotated[CallToolResult, AreaMeasurement]:
        drawn = include_overlay or client_supports_apps(ctx)
        scale = ScaleQuestion(region, reference_length_m, frame, drawn)
        question = AreaQuestion(target, gsd_m_per_px, scale)

        def work(job: Job, source: OpenedImage) -> Answer[AreaMeasurement]:
            return measure(services.settings, services.models, job, source, question)

        answer = await _run(services, ctx, image, work)
        return _result(answer, describe_area(answer.record), include_overlay)

    return _looking_tool(measure_area, "Measure the area of an object in an aerial image", _MEASURE_AREA)


async def _run(
    services: Services, ctx: Context[Any, Any], image: AnyImage, work: Callable[[Job, OpenedImage], Result]
) -> Result:
    """Find a place, fetch and open the image, and do the work in a thread, with progress from start to end."""

    async def call(stop: Stop) -> Result:
        await ctx.report_progress(0, PERCENT_DONE, "reading the image")
        fetched = await services.sources.fetched(image)

        def in_thread() -> Result:
            with services.sources.open(image, fetched) as source, Job(ctx, stop) as job:
                return work(job, source)

        result = await services.capacity.in_thread(stop, in_thread)
        await ctx.report_progress(PERCENT_DONE, PERCENT_DONE, "done")
        return result

    return await services.capacity.run(call)


def _looking_tool(function: Callable[..., Any], title: str, description: str) -> StrictTool:
    """A tool that only looks: it changes nothing, and the same call gives the same answer."""
    annotations = ToolAnnotations(
        title=title, read_only_hint=True, destructive_hint=False, idempotent_hint=True, open_world_hint=False
    )
    return StrictTool.strict(function, title=title, description=description, annotations=annotations, meta=APP_META)


def _result(answer: Answer[GsdEstimate | AreaMeasurement], sentence: str, include_overlay: bool) -> CallToolResult:
    """The record for programs, the sentence for models, the picture for those who asked, the panel for people."""
    content: list[Any] = [TextContent(type="text", text=sentence)]
    if include_overlay and answer.overlay is not None:
        content.append(Image(data=answer.overlay, format="jpeg").to_image_content())
    return CallToolResult(
        content=content,
        structured_content=answer.record.model_dump(mode="json"),
        _meta=panel_meta(answer.histogram, None if include_overlay else answer.overlay),
    )
