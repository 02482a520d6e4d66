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
from vehanchor_server.tools.target import MAX_TARGETS, MustFit, Objects, Target

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.measure.shapes import CallerPolygon
    from vehanchor.pictures.placement import Cut
    from vehanchor.segmentation.prompt import Prompt
    from vehanchor_server.tools.strict_tool import StrictTool

_DESCRIPTION = (
    "Measures the area (square metres) and size of objects in a near-nadir aerial or satellite "
    "image: roof, pool, field, landing site. Give a tight box around each whole object; never "
    "estimate an area by eye. Also returns length, width, and inscribed_diameter_m, the largest "
    "circle inside, for landings. A 20 % "
    f"error in scale is a 44 % error in area. {STATUS_RULES}"
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
                description="Objects: a box around each, points on it, or its polygon.",
                examples=[_EXAMPLE],
            ),
        ],
        ctx: Context[Any, Any],
        caller_options: CallerOptions,
        picture: PictureRequest,
        must_fit: Annotated[
            MustFit | None,
            Field(
                description="Shape that must fit inside, metres: the answer has fit_probability "
                "and its place.",
            ),
        ] = None,
        detail: DetailArgument = "short",
    ) -> CallToolResult:
        reply, answer = await run_measuring_call(
            services,
            ctx,
            image=image,
            work=_measure,
            question=Question(caller_options, picture, subject=Objects(targets, must_fit)),
            points=[point for target in targets for point in target.coordinates],
            detail=detail,
        )
        return reply.to_result(answer.text, answer.warnings, detail=detail, shown=picture)

    return StrictTool.read_only(
        measure_area,
        title="Measure the areas of objects in an aerial image",
        description=_DESCRIPTION,
        meta=APP_META,
        record=AreaMeasurement,
        listed_fields=("status", "area_m2", "scale_confidence", "inscribed_diameter_m"),
        image_kinds=services.resources.settings.image_kinds,
    )


@work(AreaMeasurement)
def _measure(
    resources: Resources, job: Job, source: OpenedImage, question: Question[Objects]
) -> Reply[AreaMeasurement]:
    """Segment the objects and measure them."""
    from vehanchor.imagery.sources.opening import open_raster
    from vehanchor.measure.area import analyse_objects
    from vehanchor.measure.fit import read_must_fit
    from vehanchor.pictures.measurement import cut_to_objects, draw_area
    from vehanchor_server.app_page.panel import drawing_of

    # Refuse invalid prompts before the models load and search.
    subjects = [_subject(target) for target in question.subject.targets]
    must_fit = None
    if question.subject.must_fit is not None:
        must_fit = read_must_fit(question.subject.must_fit.model_dump())
    segmenter = None
    if any(target.polygon is None for target in question.subject.targets):
        segmenter = resources.models.segmenter(job.runtime)
    options, scale = resolve_source(question.options, resources, job)
    job.stop.check()
    with open_raster(source, options.reading) as raster:
        job.segmenting()
        objects = analyse_objects(
            raster,
            subjects,
            segmenter=segmenter,
            scale=scale,
            options=options,
            object_height_m=question.options.get("object_height_m"),
            must_fit=must_fit,
        )
        # All objects of an image share its scale.
        evidence = objects[0].scale

        def draw(rgb: "NDArray[np.uint8]", cut: "Cut | None") -> "NDArray[np.uint8]":
            return draw_area(rgb, *objects, cut=cut)

        picture = draw_picture(
            raster,
            job,
            request=question.picture,
            draw=draw,
            scale=evidence,
            usual=cut_to_objects(objects).part,
        )
    drawing = None
    if question.picture.kind == "plain" and evidence is not None:
        drawing = drawing_of(evidence)
    measurements = tuple(analysed.measurement for analysed in objects)
    return Reply(measurements, picture=picture, drawing=drawing)


def _subject(target: Target) -> "Prompt | CallerPolygon":
    from vehanchor.measure.shapes import read_polygon
    from vehanchor.segmentation.prompt import read_prompt

    if target.polygon is not None:
        return read_polygon(target.polygon)
    if target.box is not None:
        (left, top), (right, bottom) = target.box.corners
        return read_prompt((left, top, right, bottom), None)
    points = [(point.x, point.y, point.label == "include") for point in target.points or ()]
    return read_prompt(None, points)
