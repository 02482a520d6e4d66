"""Doubts about the whole image, before a ruler measures: one perspective view, and photographed."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from vehanchor.imagery.drawing import (
    SMALL_PATCH_PX,
    drawing_chance_around,
    measure_drawing_chance,
)
from vehanchor.imagery.horizon import find_horizon
from vehanchor.imagery.raster import RasterNote, Window
from vehanchor.imagery.seams import find_seam
from vehanchor.imagery.sphere import is_sphere
from vehanchor.records.notices import NoticeCode
from vehanchor.scale.defaults import PROBABLY_RIGHT

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.detection.detections import Detections
    from vehanchor.imagery.facts import ImageFacts
    from vehanchor.imagery.raster import Raster
    from vehanchor.imagery.seams import Seam
    from vehanchor.rulers.ruler import View


def with_image_doubts(
    facts: ImageFacts,
    raster: Raster,
    *,
    metadata: bool,
    check_seams: bool,
    beside_each_other: Sequence[Raster] = (),
) -> ImageFacts:
    """Add to the facts of an image the doubts that it is one perspective view.

    ``vehanchor.rulers.witnesses.with_doubts`` counts them.

    Args:
        facts: facts of the image.
        raster: the same image, or the part of it that is a photograph, open.
        metadata: whether the metadata may be used.
        check_seams: whether to look for seams between pictures, and for the horizon.
        beside_each_other: parts of the image that are photographs; empty unless there are several.
    """
    notes = []
    if (raster.width_px, raster.height_px) != (facts.width_px, facts.height_px):
        facts = facts._replace(part=raster.part)
        notes.append(RasterNote(NoticeCode.PART_SEARCHED.value, _part_searched(facts)))
    camera = facts.camera if metadata else None
    # A map is often assembled from pictures of one scale.
    is_map = facts.georeference_gsd_m_per_px is not None
    if camera is not None and camera.projection:
        notes.append(_not_perspective(f"The file states {camera.projection}"))
    elif check_seams and not is_map and is_sphere(raster):
        notes.append(_not_perspective("The image shows all directions, by its borders"))
    if check_seams and not is_map:
        message = _several_pictures(facts, raster, beside_each_other)
        if message:
            notes.append(RasterNote(NoticeCode.SEVERAL_PICTURES.value, message))
        horizon_px = find_horizon(raster)
        if horizon_px is not None:
            message = _horizon_visible(raster.part.y_px + horizon_px)
            notes.append(RasterNote(NoticeCode.HORIZON_VISIBLE.value, message))
    return facts._replace(notices=(*facts.notices, *notes))


def with_detections(view: View, raster: Raster, detections: Detections) -> View:
    """Add the vehicles of an image, and judge by their surroundings whether they are drawn."""
    chance = drawing_chance_around(raster, detections.boxes, view.drawing_chance)
    return replace(view, detections=detections, drawing_chance=chance)


def _is_beside_drawing(raster: Raster, seam: Seam) -> bool:
    """Test whether a seam separates a photograph from a panel, a caption or a small map."""
    width = raster.width_px
    height = raster.height_px
    if seam.inset is not None:
        inset = _inside(seam.inset, width, height)
        sides = [[inset], _around(inset, width, height)]
    elif seam.x_px is not None:
        before = Window(0, 0, width_px=seam.x_px, height_px=height)
        behind = Window(seam.x_px, 0, width_px=width - seam.x_px, height_px=height)
        sides = [[before], [behind]]
    else:
        assert seam.y_px is not None
        above = Window(0, 0, width_px=width, height_px=seam.y_px)
        below = Window(0, seam.y_px, width_px=width, height_px=height - seam.y_px)
        sides = [[above], [below]]
    for parts in sides:
        chances = [measure_drawing_chance(raster, part) for part in parts]
        if chances and min(chances) >= PROBABLY_RIGHT:
            return True
    return False


def _inside(inset: Window, width: int, height: int) -> Window:
    """Cut a rectangle, which was found in a reduced copy, at the image's border."""
    right = min(inset.x_px + inset.width_px, width)
    bottom = min(inset.y_px + inset.height_px, height)
    left = min(inset.x_px, right)
    top = min(inset.y_px, bottom)
    return Window(left, top, width_px=right - left, height_px=bottom - top)


def _around(inset: Window, width: int, height: int) -> list[Window]:
    """List the strips around an inset that are broad enough to be judged."""
    right = inset.x_px + inset.width_px
    bottom = inset.y_px + inset.height_px
    strips = (
        Window(0, 0, width_px=inset.x_px, height_px=height),
        Window(right, 0, width_px=width - right, height_px=height),
        Window(0, 0, width_px=width, height_px=inset.y_px),
        Window(0, bottom, width_px=width, height_px=height - bottom),
    )
    return [strip for strip in strips if min(strip.width_px, strip.height_px) >= SMALL_PATCH_PX]


def shows_horizon(view: View) -> bool:
    """Test whether a view has the horizon in it, and no single scale."""
    codes = [notice.code for notice in view.image.notices]
    return view.tilt is None and NoticeCode.HORIZON_VISIBLE in codes


def _not_perspective(cause: str) -> RasterNote:
    """Warn that no scale holds for the image.

    Args:
        cause: what shows it, as the beginning of a sentence.
    """
    message = (
        f"{cause}: the image is not one perspective view, and no scale holds for all of it. Give a "
        "photograph that was taken straight down, or a perspective view made from this image."
    )
    return RasterNote(NoticeCode.NOT_PERSPECTIVE.value, message)


def _part_searched(facts: ImageFacts) -> str:
    """Say where the photograph is in a picture that shows other things beside it."""
    part = facts.part
    assert part is not None
    in_square = [
        (part.x_px, part.y_px),
        (part.x_px + part.width_px, part.y_px + part.height_px),
    ]
    in_file = facts.grid.to_file(in_square).round().astype(int)
    (left_px, top_px), (right_px, bottom_px) = in_file.tolist()
    return (
        f"The photograph in this picture lies from ({left_px}, {top_px}) to ({right_px}, "
        f"{bottom_px}) px. It alone was searched, and the scale is that of its pixels; margins, "
        "panels and text beside it were left out."
    )


def _horizon_visible(row_px: int) -> str:
    """Warn of the horizon, and say where it is."""
    return (
        f"The horizon is in the image, at y = {row_px} px: this is an oblique view, and no scale "
        "holds for all of it. Give a photograph that was taken straight down."
    )


def _several_pictures(
    facts: ImageFacts, raster: Raster, beside_each_other: Sequence[Raster]
) -> str:
    """Warn of several pictures, and say where they meet; empty for one picture.

    Args:
        facts: facts of the image.
        raster: the image, or the part of it that is a photograph.
        beside_each_other: as in ``with_image_doubts``.
    """
    if beside_each_other:
        corners = facts.grid.to_file([part.origin_px for part in beside_each_other])
        places = [f"({x:.0f}, {y:.0f})" for x, y in corners.tolist()]
        place = f"photographs begin at {', '.join(places)} px"
    else:
        seam = find_seam(raster)
        if seam is None or _is_beside_drawing(raster, seam):
            return ""
        place = _place_of_seam(seam.moved(*raster.origin_px))
    return (
        f"The image seems to consist of several pictures: {place}. Their scales may differ. Give "
        "each picture alone."
    )


def _place_of_seam(seam: Seam) -> str:
    """Say where a seam is."""
    if seam.y_px is None:
        return f"a straight seam at x = {seam.x_px} px crosses it"
    if seam.x_px is None:
        return f"a straight seam at y = {seam.y_px} px crosses it"
    return f"an inset has a corner at ({seam.x_px}, {seam.y_px}) px"
