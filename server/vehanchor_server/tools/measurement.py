"""Calling the library's ``measure_area`` on behalf of a caller, in a worker thread; as in ``estimation``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from vehanchor_server.errors import call_errors
from vehanchor_server.tools.answer import Answer
from vehanchor_server.tools.estimation import scale_options
from vehanchor_server.tools.target import BoxTarget

if TYPE_CHECKING:
    from vehanchor.records import AreaMeasurement
    from vehanchor.segmentation.segmenter import Prompt
    from vehanchor_server.images.source import OpenedImage
    from vehanchor_server.models import Models
    from vehanchor_server.settings import Settings
    from vehanchor_server.tools.estimation import ScaleQuestion
    from vehanchor_server.tools.job import Job
    from vehanchor_server.tools.target import AnyTarget

__all__ = ["AreaQuestion", "measure"]


@dataclass(frozen=True)
class AreaQuestion:
    """What a caller says about the area it asks for.

    Attributes:
        target: the object.
        gsd_m_per_px: the scale where the caller knows it.
        scale: how the scale is found where it does not, and what else both tools are told.
    """

    target: AnyTarget
    gsd_m_per_px: float | None
    scale: ScaleQuestion


def measure(
    settings: Settings, models: Models, job: Job, source: OpenedImage, question: AreaQuestion
) -> Answer[AreaMeasurement]:
    """Segment the object and measure it.

    Raises:
        CallError: the library refused; its code is passed on.
        CallStoppedError: the call was asked to end.
    """
    from vehanchor.estimate import open_detector
    from vehanchor.imagery.raster import open_raster
    from vehanchor.measure import analyse_object
    from vehanchor.pictures.area import draw_area
    from vehanchor_server.app_page.panel import length_histogram
    from vehanchor_server.tools.overlay import overlay_jpeg

    with call_errors(source):
        prompt = _prompt(question.target)  # what has no meaning is told before the work
        known = question.gsd_m_per_px
        options = scale_options(settings, question.scale, models if known is None else None)
        segmenter = models.segmenter()
        scale = known or open_detector(models.detector(), options)
        job.enter("decode")
        with open_raster(source, limits=options.limits) as raster:
            job.segmenting()
            analysis = analyse_object(
                raster, prompt, segmenter, scale, options, progress=job.searched, run_options=job.run_options
            )
            overlay = None
            if question.scale.include_overlay:
                job.enter("overlay")
                overlay = overlay_jpeg(raster, job.stop, lambda seen: draw_area(seen, analysis))
    histogram = None if analysis.scale is None else length_histogram(analysis.scale)
    return Answer(analysis.measurement, overlay, histogram)


def _prompt(target: AnyTarget) -> Prompt:
    from vehanchor.measure import read_prompt

    if isinstance(target, BoxTarget):
        box = target.box
        return read_prompt((box.x_min, box.y_min, box.x_max, box.y_max), None)
    return read_prompt(None, [(point.x, point.y, point.label == "include") for point in target.points])
