"""The tool ``measure_distance``: measure distances. Structured as ``estimate_gsd``."""

# No postponed annotations here: the SDK reads the arguments' schema from them.

from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from vehanchor.options.option import Number
from vehanchor.records import DistanceMeasurement
from vehanchor_server.base_model import FrozenModel
from vehanchor_server.calls.job import Job
from vehanchor_server.calls.reply import PictureRequest, Reply
from vehanchor_server.calls.task import work
from vehanchor_server.images.argument import ImageArgument
from vehanchor_server.images.source import OpenedImage
from vehanchor_server.services import Services
from vehanchor_server.tools.messages import STATUS_RULES
from vehanchor_server.tools.picture import draw_picture
from vehanchor_server.tools.scale_arguments import (
    DetailArgument,
    Given,
    Question,
    answered,
    resolve_source,
    with_options,
)
from vehanchor_server.tools.target import MAX_POINTS, MAX_TARGETS

if TYPE_CHECKING:
    from vehanchor_server.tools.strict_tool import StrictTool

_DESCRIPTION = (
    "Measures ground distances (metres) in a near-nadir aerial or satellite image: how wide, "
    "how long, how far. "
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


def measure_distance_tool(services: Services) -> "StrictTool":
    """Create the tool for a server."""
    from vehanchor_server.tools.strict_tool import CallToolResult, Context, StrictTool

    @with_options("measure", paged=False)
    async def measure_distance(
        image: ImageArgument,
        lines: Annotated[
            tuple[Line, ...],
            Field(
                min_length=1,
                max_length=MAX_TARGETS,
                description="Each is measured separately.",
                examples=[_EXAMPLE],
            ),
        ],
        ctx: Context[Any, Any],
        given: Given,
        wanted: PictureRequest,
        detail: DetailArgument = "short",
    ) -> CallToolResult:
        places = [(point.x, point.y) for line in lines for point in line.points]
        question = Question(given, wanted, lines)
        reply, told = await answered(
            services, ctx, image, _measure, question, places, detail=detail
        )
        return reply.to_result(*told, detail=detail, shown=wanted)

    return StrictTool.read_only(
        measure_distance,
        title="Measure distances in an aerial image",
        description=_DESCRIPTION,
        record=DistanceMeasurement,
        answered=("status", "distance_m", "scale_confidence"),
        kinds=services.settings.image_kinds,
    )


@work(DistanceMeasurement)
def _measure(
    services: Services, job: Job, source: OpenedImage, asked: Question[tuple[Line, ...]]
) -> Reply[DistanceMeasurement]:
    """Measure the lines."""
    from vehanchor.imagery.sources.opening import open_raster
    from vehanchor.measure.distance import analyse_paths, read_path
    from vehanchor.pictures.measurement import cut_to_lines, draw_distance

    paths = [read_path([(point.x, point.y) for point in line.points]) for line in asked.subject]
    options, scale = resolve_source(asked.given, services, job)
    height = asked.given.get("object_height_m")
    job.stop.check()
    with open_raster(source, options.reading) as raster:
        found = analyse_paths(raster, paths, scale=scale, options=options, object_height_m=height)
        measured = tuple(each.measurement for each in found)
        picture = draw_picture(
            raster,
            job,
            wanted=asked.wanted,
            draw=lambda seen, cut: draw_distance(seen, *found, cut=cut),
            scale=found[0].scale,
            usual=cut_to_lines(measured).part,
        )
    return Reply(measured, picture)
