"""The tool ``measure_area``: measure the areas of objects. Structured as ``estimate_gsd``."""

# No postponed annotations here: the SDK reads the arguments' schema from them.

from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from vehanchor.records import AreaMeasurement
from vehanchor_server.app_page.page import APP_META
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
from vehanchor_server.tools.target import MAX_TARGETS, Target

if TYPE_CHECKING:
    from vehanchor.segmentation.prompt import Prompt
    from vehanchor_server.tools.strict_tool import StrictTool

_DESCRIPTION = (
    "Measures the area (square metres) and size of objects in a near-nadir aerial or satellite "
    "image: roof, pool, "
    "field, landing site. Give a tight box around each whole object; never estimate an area by "
    "eye. Also "
    "returns length, width, and inscribed_diameter_m, the largest circle inside, for landings. "
    "ok needs a usable scale "
    f"and a mask without doubts; 20 % of the scale is 44 % of an area. {STATUS_RULES}"
)


_EXAMPLE = [{"box": {"x_min": 255, "y_min": 160, "x_max": 535, "y_max": 470}}]


def measure_area_tool(services: Services) -> "StrictTool":
    """Create the tool for a server."""
    from vehanchor_server.tools.strict_tool import CallToolResult, Context, StrictTool

    @with_options("measure")
    async def measure_area(
        image: ImageArgument,
        targets: Annotated[
            tuple[Target, ...],
            Field(
                min_length=1,
                max_length=MAX_TARGETS,
                description="Box or points of each.",
                examples=[_EXAMPLE],
            ),
        ],
        ctx: Context[Any, Any],
        given: Given,
        wanted: PictureRequest,
        detail: DetailArgument = "short",
    ) -> CallToolResult:
        places = [place for target in targets for place in target.places]
        question = Question(given, wanted, targets)
        reply, told = await answered(
            services, ctx, image, _measure, question, places, detail=detail
        )
        return reply.to_result(*told, detail=detail, shown=wanted)

    return StrictTool.read_only(
        measure_area,
        title="Measure the areas of objects in an aerial image",
        description=_DESCRIPTION,
        meta=APP_META,
        record=AreaMeasurement,
        answered=("status", "area_m2", "scale_confidence", "inscribed_diameter_m"),
        kinds=services.settings.image_kinds,
    )


@work(AreaMeasurement)
def _measure(
    services: Services, job: Job, source: OpenedImage, asked: Question[tuple[Target, ...]]
) -> Reply[AreaMeasurement]:
    """Segment the objects and measure them."""
    from vehanchor.imagery.sources.opening import open_raster
    from vehanchor.measure.area import analyse_objects
    from vehanchor.pictures.measurement import cut_to_objects, draw_area
    from vehanchor_server.app_page.panel import drawing_of

    # refuse invalid prompts before the work
    prompts = [_prompt(target) for target in asked.subject]
    segmenter = services.models.segmenter(job.runtime)
    options, scale = resolve_source(asked.given, services, job)
    wanted = asked.wanted
    height = asked.given.get("object_height_m")
    job.stop.check()
    with open_raster(source, options.reading) as raster:
        job.segmenting()
        found = analyse_objects(
            raster,
            prompts,
            segmenter=segmenter,
            scale=scale,
            options=options,
            object_height_m=height,
        )
        picture = draw_picture(
            raster,
            job,
            wanted=wanted,
            draw=lambda seen, cut: draw_area(seen, *found, cut=cut),
            scale=found[0].scale,
            usual=cut_to_objects(found).part,
        )
    drawing = (
        drawing_of(found[0].scale)
        if wanted.kind == "plain" and found[0].scale is not None
        else None
    )
    return Reply(tuple(each.measurement for each in found), picture, drawing)


def _prompt(target: Target) -> "Prompt":
    from vehanchor.segmentation.prompt import read_prompt

    if target.box is not None:
        (left, top), (right, bottom) = target.box.corners
        return read_prompt((left, top, right, bottom), None)
    return read_prompt(
        None, [(point.x, point.y, point.label == "include") for point in target.points or ()]
    )
