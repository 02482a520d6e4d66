"""Doubts about the whole image, before a ruler measures: one perspective view, and photographed."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from vehanchor.imagery.drawing import drawing_chance_around
from vehanchor.imagery.horizon import find_horizon
from vehanchor.imagery.raster import RasterNote
from vehanchor.imagery.seams import find_seam
from vehanchor.records.notices import NoticeCode

if TYPE_CHECKING:
    from vehanchor.detection.detections import Detections
    from vehanchor.imagery.facts import ImageFacts
    from vehanchor.imagery.raster import Raster
    from vehanchor.imagery.seams import Seam
    from vehanchor.rulers.ruler import View


def with_image_doubts(
    facts: ImageFacts, raster: Raster, *, metadata: bool, check_seams: bool
) -> ImageFacts:
    """Add to the facts of an image the doubts that it is one perspective view.

    ``vehanchor.rulers.witnesses.with_doubts`` counts them.

    Args:
        facts: facts of the image.
        raster: the same image, open.
        metadata: whether the metadata may be used.
        check_seams: whether to look for seams between pictures, and for the horizon.
    """
    notes = []
    camera = facts.camera if metadata else None
    if camera is not None and camera.projection:
        message = (
            f"The file states {camera.projection}: the image is not one perspective view, and no "
            "scale holds for all of it. Give a photograph that was taken straight down, or a "
            "perspective view made from this image."
        )
        notes.append(RasterNote(NoticeCode.NOT_PERSPECTIVE.value, message))
    # A map is often assembled from pictures of one scale.
    is_map = facts.georeference_gsd_m_per_px is not None
    if check_seams and not is_map:
        seam = find_seam(raster)
        if seam is not None:
            notes.append(RasterNote(NoticeCode.SEVERAL_PICTURES.value, _several_pictures(seam)))
        horizon_px = find_horizon(raster)
        if horizon_px is not None:
            notes.append(RasterNote(NoticeCode.HORIZON_VISIBLE.value, _horizon_visible(horizon_px)))
    return facts._replace(notices=(*facts.notices, *notes))


def with_detections(view: View, raster: Raster, detections: Detections) -> View:
    """Add the vehicles of an image, and judge by their surroundings whether they are drawn."""
    chance = drawing_chance_around(raster, detections.boxes, view.drawing_chance)
    return replace(view, detections=detections, drawing_chance=chance)


def shows_horizon(view: View) -> bool:
    """Test whether a view has the horizon in it, and no single scale."""
    codes = [notice.code for notice in view.image.notices]
    return view.tilt is None and NoticeCode.HORIZON_VISIBLE in codes


def _horizon_visible(row_px: int) -> str:
    """Warn of the horizon, and say where it is."""
    return (
        f"The horizon is in the image, at y = {row_px} px: this is an oblique view, and no scale "
        "holds for all of it. Give a photograph that was taken straight down."
    )


def _several_pictures(seam: Seam) -> str:
    """Warn of a seam, and say where it is."""
    if seam.y_px is None:
        place = f"a straight seam at x = {seam.x_px} px crosses it"
    elif seam.x_px is None:
        place = f"a straight seam at y = {seam.y_px} px crosses it"
    else:
        place = f"an inset has a corner at ({seam.x_px}, {seam.y_px}) px"
    return (
        f"The image seems to consist of several pictures: {place}. Their scales may differ. Give "
        "each picture alone."
    )
