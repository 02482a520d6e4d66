"""Build the reply of a scale analysis: its record and its pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor_server.calls.reply import Reply

if TYPE_CHECKING:
    from vehanchor.analysis.scale import ScaleAnalysis
    from vehanchor.imagery.raster import Raster
    from vehanchor.records import GsdEstimate
    from vehanchor_server.calls.job import Job
    from vehanchor_server.calls.reply import PictureRequest


def scale_reply(raster: Raster | None, analysis: ScaleAnalysis, wanted: PictureRequest, job: Job) -> Reply[GsdEstimate]:
    """Combine the record with the requested pictures.

    Args:
        raster: the open image; None if no picture is requested.
        analysis: its scale analysis.
        wanted: the requested pictures.
        job: receives progress.

    Raises:
        CallStoppedError: the call was stopped.
    """
    from vehanchor.pictures.scale import draw_overlay
    from vehanchor_server.app_page.panel import drawing_of
    from vehanchor_server.calls.overlay import Pictures, draw_pictures

    pictures = Pictures()
    if raster is not None:
        pictures = draw_pictures(raster, job, wanted, lambda seen: draw_overlay(seen, analysis))
    drawing = drawing_of(analysis) if wanted.page else None
    return Reply((analysis.estimate,), pictures.overlay, pictures.page, drawing)
