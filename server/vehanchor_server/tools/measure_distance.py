"""The tool ``measure_distance``: measure distances. Structured as ``estimate_gsd``."""

# No postponed annotations here: the SDK reads the result's schema from them.

from dataclasses import dataclass
from typing import Annotated, Any

from mcp.server.mcpserver import Context
from mcp.types import CallToolResult
from pydantic import Field

from vehanchor.records import DistanceMeasurement
from vehanchor_server.calls.call import run_call
from vehanchor_server.calls.job import Job
from vehanchor_server.calls.reply import Detail, PictureRequest, Reply
from vehanchor_server.calls.task import work
from vehanchor_server.frozen import FrozenModel, Number
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
from vehanchor_server.tools.target import MAX_POINTS, MAX_TARGETS

_DESCRIPTION = (
    "Measures ground distances (metres) in a near-nadir aerial or satellite image: how wide, how long, how far. "
    f"Give two points, or the vertices of a path in order. {STATUS_RULES}"
)


_EXAMPLE = [{"points": [{"x": 120, "y": 300}, {"x": 480, "y": 310}]}]


class Place(FrozenModel):
    """A vertex of the line."""

    x: Number
    y: Number


class Line(FrozenModel):
    """A path of straight segments."""

    points: tuple[Place, ...] = Field(min_length=2, max_length=MAX_POINTS)


@dataclass(frozen=True)
class _Question:
    """Lines and scale arguments of a call, and the requested picture."""

    lines: tuple[Line, ...]
    scale: ScaleArguments
    wanted: PictureRequest


def measure_distance_tool(services: Services) -> StrictTool:
    """Create the tool for a server."""

    async def measure_distance(
        image: ImageArgument,
        lines: Annotated[
            tuple[Line, ...],
            Field(
                min_length=1, max_length=MAX_TARGETS, description="Each is measured separately.", examples=[_EXAMPLE]
            ),
        ],
        ctx: Context[Any, Any],
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
    ) -> Annotated[CallToolResult, DistanceMeasurement]:
        height = (height_m, height_basis, height_tolerance_m, focal_35mm)
        stated = stated_scale(gsd_m_per_px, gsd_basis, gsd_tolerance)
        facts = (region, reference_length_m, frame, known_lengths, *height, coordinates)
        question = ScaleQuestion(*facts, drop=drop, add=add, stated=stated)
        by = ScaleArguments(question, object_height_m)
        asked = _Question(lines, by, PictureRequest(include_overlay, False, overlay_side_px))
        answer = await run_call(services, ctx, image, _measure, asked)
        first = answer.record
        places = ((point.x, point.y) for line in lines for point in line.points)
        words = [
            numbered([_distance_in_words(record) for record in answer.records]),
            *warnings_of(answer.records, detail),
            *copy_hint(places, question, first.image_width_px, first.image_height_px),
        ]
        return answer.to_result(" ".join(words), detail=detail)

    return StrictTool.read_only(
        measure_distance,
        title="Measure distances in an aerial image",
        description=_DESCRIPTION,
        answered=("status", "distance_m", "confidence"),
        listing=Listing(UNLISTED_ARGUMENTS, services.settings.image_kinds),
    )


@work(DistanceMeasurement)
def _measure(services: Services, job: Job, source: OpenedImage, question: _Question) -> Reply[DistanceMeasurement]:
    """Measure the lines, in a worker process or thread.

    Raises:
        VehAnchorError: the library refused the image or an option.
        CallError: a model cannot be loaded.
        CallStoppedError: the call was stopped.
    """
    from vehanchor.imagery.sources.opening import open_raster
    from vehanchor.measure.distance import analyse_paths, read_path
    from vehanchor.pictures.distance import cut_to_lines, draw_distance
    from vehanchor_server.calls.overlay import draw_pictures

    paths = [read_path([(point.x, point.y) for point in line.points]) for line in question.lines]
    options, scale = question.scale.resolve(services, job)
    job.stop.check()
    with open_raster(source, limits=options.reading.limits) as raster:
        found = analyse_paths(
            raster,
            paths,
            scale,
            options,
            object_height_m=question.scale.object_height_m,
        )
        measured = tuple(each.measurement for each in found)
        cut = cut_to_lines(measured, question.wanted.long_side_px)
        overlay = draw_pictures(
            raster, job, question.wanted, lambda seen: draw_distance(seen, *found, cut=cut), cut.part
        ).overlay
    return Reply(measured, overlay)


def describe_distance(record: DistanceMeasurement, detail: Detail = "full") -> str:
    """Describe the distance and its status in one sentence, and each warning in another."""
    return " ".join([_distance_in_words(record), *warnings_of([record], detail)])


def _distance_in_words(record: DistanceMeasurement) -> str:
    if record.distance_m is None:
        return f"No distance: the line is {record.length_px:.0f} px long, but {no_scale_message(record.estimate)}."
    text = f"{rounded(record.distance_m)} m{interval(record.distance_ci95_low_m, record.distance_ci95_high_m)}"
    text += f"; {scale_origin(record)}: "
    if record.status == "ok":
        return text + "safe to use."
    return text + unusable_scale(record.estimate)
