"""The tool ``estimate_gsd``: estimate the scale of an image.

The call imports the library, because importing OpenCV and ONNX Runtime would delay the server's
first answer.
"""

# No postponed annotations here: the SDK reads the arguments' schema from them.

from typing import TYPE_CHECKING, Annotated, Any

from pydantic import Field

from vehanchor.options.option import Flag
from vehanchor.records import GsdEstimate
from vehanchor_server.app_page.page import APP_META
from vehanchor_server.calls.job import Job
from vehanchor_server.calls.reply import PictureRequest, Reply
from vehanchor_server.calls.task import work
from vehanchor_server.images.argument import ImageArgument
from vehanchor_server.images.source import OpenedImage
from vehanchor_server.resources import Resources
from vehanchor_server.services import Services
from vehanchor_server.tools.flight_question import (
    EstimateSubject,
    MoreImagesArgument,
    SameScaleArgument,
    check_flight_options,
    estimate_with_flight,
)
from vehanchor_server.tools.measuring_call import run_measuring_call
from vehanchor_server.tools.messages import POLICY
from vehanchor_server.tools.picture import scale_reply
from vehanchor_server.tools.scale_arguments import (
    CallerOptions,
    DetailArgument,
    Question,
    scale_options,
    with_options,
)

if TYPE_CHECKING:
    from vehanchor_server.tools.strict_tool import StrictTool

_KNOWN_SIZES = (
    "parking_bay_width",
    "lane_dash_cycle",
    "zebra_bar",
    "railway_gauge",
    "iso_container_20ft",
    "solar_panel_width",
    "tennis_court_length",
    "football_penalty_area_width",
    "pool_25m",
)
"""Names that the description lists; ``view_image`` lists all with their meanings."""

_DESCRIPTION = (
    "Measures the scale (metres per pixel) of a near-nadir aerial or satellite image from cars, "
    "known lengths, camera height or metadata. Call it before any metric statement; never "
    "estimate the scale by eye. Needs cars at 0.3 m/px or finer, or another ruler. "
    f"{POLICY} Names for known_lengths, among others: {', '.join(_KNOWN_SIZES)}; view_image with "
    "known_sizes explains all."
)


def estimate_gsd_tool(services: Services) -> "StrictTool":
    """Create the tool for a server."""
    from vehanchor_server.tools.elicitation import request_scale_input, with_user_input
    from vehanchor_server.tools.strict_tool import (
        CallToolResult,
        Context,
        InputRequiredResult,
        StrictTool,
    )

    settings = services.resources.settings

    @with_options("estimate")
    async def estimate_gsd(
        image: ImageArgument,
        ctx: Context[Any, Any],
        caller_options: CallerOptions,
        picture: PictureRequest,
        target_gsd_m_per_px: Annotated[
            float | None,
            Field(gt=0, description="Scale that another model needs: how to resample for it."),
        ] = None,
        detail: DetailArgument = "short",
        more_images: MoreImagesArgument = None,
        same_scale: SameScaleArgument = False,
        list_vehicles: Annotated[
            Flag, Field(description="List the vehicles with their numbers for drop.")
        ] = False,
    ) -> CallToolResult | InputRequiredResult:
        options = with_user_input(ctx, caller_options)
        if more_images:
            check_flight_options(options)
        reply, answer = await run_measuring_call(
            services,
            ctx,
            image=image,
            work=estimate_with_flight if more_images else _estimate,
            question=Question(options, picture, subject=EstimateSubject(same_scale, list_vehicles)),
            more=more_images or (),
            target_gsd_m_per_px=target_gsd_m_per_px,
            detail=detail,
        )
        # Forms are for a person's own call about one image.
        if not (more_images or settings.never_ask or picture.kind == "evidence"):
            request = request_scale_input(ctx, options, estimate=reply.record, answer=answer.text)
            if request is not None:
                return request
        return reply.to_result(answer.text, answer.warnings, detail=detail, shown=picture)

    return StrictTool.read_only(
        estimate_gsd,
        title="Measure the scale of an aerial image",
        description=_DESCRIPTION,
        meta=APP_META,
        record=GsdEstimate,
        listed_fields=("status", "gsd_m_per_px", "confidence"),
        image_kinds=settings.image_kinds,
    )


@work(GsdEstimate)
def _estimate(
    resources: Resources, job: Job, source: OpenedImage, question: Question[EstimateSubject]
) -> Reply[GsdEstimate]:
    """Search the image and estimate its scale."""
    from vehanchor.analysis.pipeline import checked_detector
    from vehanchor.imagery.sources.opening import open_raster

    detector = resources.models.detector(job.runtime)
    options = scale_options(question.options, resources.settings, models=resources.models)
    checked_detector(detector, options)
    job.stop.check()
    with open_raster(source, options.reading) as raster:
        analysis = resources.models.memory.analyse(detector, raster, options)
        return scale_reply(
            raster,
            analysis,
            request=question.picture,
            job=job,
            lists_vehicles=question.subject.lists_vehicles,
        )
