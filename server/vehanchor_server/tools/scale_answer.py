"""The answer that an analysis of the scale gives: its record, and the pictures that explain it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor_server.calls.answer import Answer

if TYPE_CHECKING:
    from vehanchor.analysis.scale import ScaleAnalysis
    from vehanchor.imagery.raster import Raster
    from vehanchor.records import GsdEstimate
    from vehanchor_server.calls.answer import WantedPictures
    from vehanchor_server.calls.job import Job


def scale_answer(
    raster: Raster | None, analysis: ScaleAnalysis, wanted: WantedPictures, job: Job
) -> Answer[GsdEstimate]:
    """Draw what was wanted, and put it beside the record.

    Args:
        raster: the open image; None where no picture is wanted.
        analysis: of it.
        wanted: which pictures.
        job: is told of the drawing.

    Raises:
        CallStoppedError: the call was asked to end.
    """
    from vehanchor.pictures.scale import draw_overlay
    from vehanchor_server.app_page.panel import drawing_of, length_histogram
    from vehanchor_server.calls.overlay import Pictures, draw_pictures

    pictures = Pictures()
    if raster is not None:
        pictures = draw_pictures(raster, job, wanted, lambda seen: draw_overlay(seen, analysis))
    drawing = drawing_of(analysis) if wanted.page else None
    return Answer((analysis.estimate,), pictures.overlay, length_histogram(analysis), pictures.page, drawing)
