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
from vehanchor_server.resources import Resources
from vehanchor_server.services import Services
from vehanchor_server.tools.measuring_call import run_measuring_call
from vehanchor_server.tools.messages import STATUS_RULES
from vehanchor_server.tools.picture import draw_picture
from vehanchor_server.tools.scale_arguments import (
    CallerOptions,
    DetailArgument,
    Question,
    resolve_source,
    with_options,
)
from vehanchor_server.tools.target import MAX_POINTS, MAX_TARGETS

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.pictures.placement import Cut
    from vehanchor_server.tools.strict_tool import StrictTool

_DESCRIPTION = (
    "Measures ground distances (metres) in a near-nadir aerial or satellite image: how wide, "
    "how long, how far. Give two points, or the vertices of a path in order. "
    f"{STATUS_RULES}"
)

_EXAMPLE = [{"points": [{"x": 120, "y": 300}, {"x": 480, "y": 310}]}]


class Vertex(FrozenModel):
    """A vertex of the line."""

    x: Number
    y: Number


class Line(FrozenModel):
    """A path of straight segments."""

    points: tuple[Vertex, ...] = Field(min_length=2, max_length=MAX_POINTS)

    @property
    def coordinates(self) -> list[tuple[float, float]]:
        """The vertices, in order."""
        return [(point.x, point.y) for point in self.points]


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
                description="Lines to measure, each separately.",
                examples=[_EXAMPLE],
            ),
        ],
        ctx: Context[Any, Any],
        caller_options: CallerOptions,
        picture: PictureRequest,
        detail: DetailArgument = "short",
    ) -> CallToolResult:
        reply, answer = await run_measuring_call(
            services,
            ctx,
            image=image,
            work=_measure,
            question=Question(caller_options, picture, subject=lines),
            points=[point for line in lines for point in line.coordinates],
            detail=detail,
        )
        return reply.to_result(answer.text, answer.warnings, detail=detail, shown=picture)

    return StrictTool.read_only(
        measure_distance,
        title="Measure distances in an aerial image",
        description=_DESCRIPTION,
        record=DistanceMeasurement,
        listed_fields=("status", "distance_m", "scale_confidence"),
        image_kinds=services.resources.settings.image_kinds,
    )


@work(DistanceMeasurement)
def _measure(
    resources: Resources, job: Job, source: OpenedImage, question: Question[tuple[Line, ...]]
) -> Reply[DistanceMeasurement]:
    """Measure the lines."""
    from vehanchor.imagery.sources.opening import open_raster
    from vehanchor.measure.distance import analyse_paths, read_path
    from vehanchor.pictures.measurement import cut_to_lines, draw_distance

    paths = [read_path(line.coordinates) for line in question.subject]
    options, scale = resolve_source(question.options, resources, job)
    job.stop.check()
    with open_raster(source, options.reading) as raster:
        analyses = analyse_paths(
            raster,
            paths,
            scale=scale,
            options=options,
            object_height_m=question.options.get("object_height_m"),
        )

        def draw(rgb: "NDArray[np.uint8]", cut: "Cut | None") -> "NDArray[np.uint8]":
            return draw_distance(rgb, *analyses, cut=cut)

        picture = draw_picture(
            raster,
            job,
            request=question.picture,
            draw=draw,
            scale=analyses[0].scale,
            usual=cut_to_lines(analyses).part,
        )
    measurements = tuple(analysis.measurement for analysis in analyses)
    return Reply(measurements, picture=picture)
