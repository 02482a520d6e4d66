"""Calling the library's ``estimate_gsd`` on behalf of a caller, in a worker thread.

The library is imported by the call: OpenCV and ONNX Runtime would make the server's first answer wait.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

from vehanchor.errors import VehAnchorError
from vehanchor_server.errors import CallError

if TYPE_CHECKING:
    from vehanchor.imagery import ImageLimits
    from vehanchor.records import GsdEstimate
    from vehanchor_server.image_argument import Frame
    from vehanchor_server.image_source import OpenedImage
    from vehanchor_server.job import Job
    from vehanchor_server.models import Models
    from vehanchor_server.settings import Settings

__all__ = ["ScaleQuestion", "call_errors", "estimate", "image_limits"]


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


def estimate(
    settings: Settings, models: Models, job: Job, source: OpenedImage, question: ScaleQuestion
) -> tuple[GsdEstimate, bytes | None]:
    """The record, and the overlay as JPEG if it was asked for.

    Raises:
        CallError: the library refused; its code is passed on.
        CallStoppedError: the call was asked to end.
    """
    from vehanchor.imagery import open_raster
    from vehanchor.perception import ScaleOptions, analyse_raster, open_detector
    from vehanchor_server.overlay import overlay_jpeg

    detector = models.detector()
    with call_errors(source):
        options = ScaleOptions(
            min_score=settings.min_score,
            region=question.region,
            reference_length_m=question.reference_length_m,
            frame_width_px=question.frame.width_px if question.frame else None,
            frame_height_px=question.frame.height_px if question.frame else None,
            limits=image_limits(settings),
        )
        open_detector(detector, options)  # an unknown region is told before the work
        job.enter("decode")
        with open_raster(source, limits=options.limits) as raster:
            analysis = analyse_raster(raster, detector, options, progress=job.searched, run_options=job.run_options)
            overlay = None
            if question.include_overlay:
                job.enter("overlay")
                overlay = overlay_jpeg(raster, analysis, job.stop)
    return analysis.estimate, overlay


def image_limits(settings: Settings) -> ImageLimits:
    """What an image may cost here."""
    from vehanchor.imagery import ImageLimits

    return ImageLimits(
        max_bytes=round(settings.max_image_mb * (1 << 20)),
        max_pixels=round(settings.max_megapixels * 1e6),
        max_windowed_pixels=round(settings.max_windowed_megapixels * 1e6),
    )


@contextmanager
def call_errors(source: OpenedImage) -> Iterator[None]:
    """Pass the library's errors on to the caller, without the name under which the server opened the file.

    Raises:
        CallError: instead of a ``VehAnchorError``, with its code.
    """
    try:
        yield
    except VehAnchorError as error:
        message = (
            str(error).replace(repr(source), "image").replace(source, "image")
            if isinstance(source, str)
            else str(error)
        )
        raise CallError(error.code, message if message.endswith(".") else f"{message}.") from error
