"""Calling the library's ``estimate_gsd`` on behalf of a caller, in a worker thread.

The library is imported by the call: OpenCV and ONNX Runtime would make the server's first answer wait.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from vehanchor_server.errors import call_errors
from vehanchor_server.tools.answer import Answer

if TYPE_CHECKING:
    from vehanchor.estimate import ScaleOptions
    from vehanchor.options import ImageLimits
    from vehanchor.records import GsdEstimate
    from vehanchor_server.images.argument import Frame
    from vehanchor_server.images.source import OpenedImage
    from vehanchor_server.models import Models
    from vehanchor_server.settings import Settings
    from vehanchor_server.tools.job import Job

__all__ = ["ScaleQuestion", "estimate", "scale_options"]


@dataclass(frozen=True)
class ScaleQuestion:
    """What a caller says about the scale it asks for.

    Attributes:
        region: where the image was taken.
        reference_length_m: the length of cars there.
        frame: the copy that the caller sees.
        include_overlay: whether it wants a picture.
    """

    region: str | None
    reference_length_m: float | None
    frame: Frame | None
    include_overlay: bool

    @property
    def fleet_unknown(self) -> bool:
        """Whether the caller says nothing about the cars there."""
        return self.region is None and self.reference_length_m is None


def estimate(
    settings: Settings, models: Models, job: Job, source: OpenedImage, question: ScaleQuestion
) -> Answer[GsdEstimate]:
    """Search the image for vehicles and measure them.

    Raises:
        CallError: the library refused; its code is passed on.
        CallStoppedError: the call was asked to end.
    """
    from vehanchor.estimate import analyse_raster, open_detector
    from vehanchor.imagery.raster import open_raster
    from vehanchor.pictures.scale import draw_overlay
    from vehanchor_server.app_page.panel import length_histogram
    from vehanchor_server.tools.overlay import overlay_jpeg

    detector = models.detector()
    with call_errors(source):
        options = scale_options(settings, question, models)
        open_detector(detector, options)  # an unknown region is told before the work
        job.enter("decode")
        with open_raster(source, limits=options.limits) as raster:
            analysis = analyse_raster(raster, detector, options, progress=job.searched, run_options=job.run_options)
            overlay = None
            if question.include_overlay:
                job.enter("overlay")
                overlay = overlay_jpeg(raster, job.stop, lambda seen: draw_overlay(seen, analysis))
    return Answer(analysis.estimate, overlay, length_histogram(analysis))


def scale_options(settings: Settings, question: ScaleQuestion, models: Models | None) -> ScaleOptions:
    """The method's options: thresholds, limits and calibration by the operator, the rest by the caller.

    A caller who knows where the image was taken knows more than the operator's calibration, which is then left out.

    Args:
        settings: the operator's.
        question: the caller's.
        models: have the calibration; None where the scale is known and no vehicle is searched.

    Raises:
        CallError: the calibration cannot be loaded.
        InvalidParameterError: the caller's options contradict each other.
    """
    from vehanchor.estimate import ScaleOptions

    return ScaleOptions(
        min_score=settings.min_score,
        region=question.region,
        reference_length_m=question.reference_length_m,
        calibration=models.calibration() if models and question.fleet_unknown else None,
        frame_width_px=question.frame.width_px if question.frame else None,
        frame_height_px=question.frame.height_px if question.frame else None,
        limits=_image_limits(settings),
    )


def _image_limits(settings: Settings) -> ImageLimits:
    """What an image may cost here."""
    from vehanchor.options import ImageLimits

    return ImageLimits(
        max_bytes=round(settings.max_image_mb * (1 << 20)),
        max_pixels=round(settings.max_megapixels * 1e6),
        max_windowed_pixels=round(settings.max_windowed_megapixels * 1e6),
    )
