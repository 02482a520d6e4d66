"""Pictures of calls: the plain image for a page, or what the call saw."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.errors import PromptError
from vehanchor_server.calls.listed_vehicle import list_vehicles
from vehanchor_server.calls.reply import Reply

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster, Window
    from vehanchor.pictures.evidence import ScaleEvidence
    from vehanchor.pictures.placement import Cut
    from vehanchor.records import GsdEstimate
    from vehanchor_server.calls.job import Job
    from vehanchor_server.calls.reply import PictureRequest

_MIN_PART_PX = 16


def draw_picture(
    raster: Raster,
    job: Job,
    *,
    request: PictureRequest,
    draw: Callable[[NDArray[np.uint8], Cut | None], NDArray[np.uint8]],
    scale: ScaleEvidence | None,
    usual: Window | None = None,
) -> bytes | None:
    """Make the requested picture as JPEG; None if the request is for no picture.

    A strip of enlarged vehicles below the evidence lets the viewer check them: the first ones, or
    those in the part that the request names.

    Args:
        raster: the image.
        job: can stop before the reading.
        request: the requested picture.
        draw: draws the evidence on the image, its part or a reduced copy, ``[h, w, 3]`` RGB.
        scale: the analysis with the vehicles; None for a stated scale.
        usual: the part that the evidence shows if the request names none; None for all of the
            image.

    Raises:
        PromptError: the part is outside the image, or too small.
        CallStoppedError: the call was stopped.
    """
    import numpy as np

    from vehanchor.pictures.placement import Cut
    from vehanchor.pictures.scale import read_reduced
    from vehanchor.pictures.vehicle_strip import draw_vehicle_strip
    from vehanchor_server.calls.jpeg import MAX_PAGE_BYTES, small_jpeg

    if not request.kind:
        return None
    job.stop.check()
    if request.kind == "plain":
        return small_jpeg(read_reduced(raster), MAX_PAGE_BYTES)
    part = usual
    if request.part is not None:
        part = part_window(raster, request)
    cut = None
    if part is not None:
        cut = Cut(part, request.long_side_px)
    picture = draw(read_reduced(raster, part), cut)
    if scale is not None:
        within = part if request.part is not None else None
        strip = draw_vehicle_strip(raster, scale, picture.shape[1], within=within)
        picture = np.concatenate([picture, strip])
    return small_jpeg(picture, side_px=request.long_side_px)


def scale_reply(
    raster: Raster | None,
    analysis: ScaleEvidence,
    *,
    request: PictureRequest,
    job: Job,
    lists_vehicles: bool = False,
) -> Reply[GsdEstimate]:
    """Combine the record of a scale with the requested picture.

    Args:
        raster: the image; None if the request is for no picture.
        analysis: the scale with its evidence.
        request: the requested picture.
        job: can stop before the reading.
        lists_vehicles: whether the caller asks for the vehicles.
    """
    from vehanchor.pictures.scale import draw_overlay
    from vehanchor_server.app_page.panel import drawing_of

    def draw(rgb: NDArray[np.uint8], cut: Cut | None) -> NDArray[np.uint8]:
        return draw_overlay(rgb, analysis, cut)

    picture = None
    if raster is not None:
        picture = draw_picture(raster, job, request=request, draw=draw, scale=analysis)
    drawing = None
    if request.kind == "plain":
        drawing = drawing_of(analysis)
    vehicles = list_vehicles(analysis) if lists_vehicles else None
    return Reply((analysis.estimate,), picture=picture, drawing=drawing, vehicles=vehicles)


def part_window(raster: Raster, request: PictureRequest) -> Window:
    """Return the part that a picture shows, in whole square pixels; all of the image without one.

    A part that reaches beyond the image is clipped to it.

    Raises:
        PromptError: the part is outside the image, or too small.
    """
    from vehanchor.imagery.raster import Window
    from vehanchor.options.reading import CoordinateFrame

    corners = request.part
    if corners is None:
        return Window(0, 0, width_px=raster.width_px, height_px=raster.height_px)
    coordinates = CoordinateFrame(request.frame, raster.grid)
    upper_left, lower_right = corners
    left, top = coordinates.in_image(*upper_left)
    right, bottom = coordinates.in_image(*lower_right)
    x = int(left)
    y = int(top)
    width = round(right) - x
    height = round(bottom) - y
    if min(width, height) < _MIN_PART_PX:
        numbers = ", ".join(f"{value:g}" for corner in corners for value in corner)
        hint = coordinates.other_reading(corners)
        raise PromptError(
            f"part {numbers} covers {width} x {height} px of the {coordinates.name}: give at least "
            f"{_MIN_PART_PX} px per side{hint}"
        )
    return Window(x, y, width_px=width, height_px=height)
