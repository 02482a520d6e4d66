"""Pictures of calls: the plain image for a page, or what the call saw."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.errors import PromptError
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

_LEAST_PART_PX = 16


def draw_picture(
    raster: Raster,
    job: Job,
    wanted: PictureRequest,
    draw: Callable[[NDArray[np.uint8], Cut | None], NDArray[np.uint8]],
    *,
    scale: ScaleEvidence | None,
    usual: Window | None = None,
) -> bytes | None:
    """Make the requested picture; unless a part is asked for, the evidence has a strip of enlarged vehicles below.

    Args:
        raster: the image.
        job: can stop before the reading.
        wanted: the requested picture.
        draw: draws the evidence on the image, its part or a reduced copy, ``[h, w, 3]`` RGB.
        scale: the analysis with the vehicles; None for a stated scale.
        usual: the part that the evidence shows unless another is asked for; None for all of the
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

    if not wanted.kind:
        return None
    job.stop.check()
    if wanted.kind == "plain":
        return small_jpeg(read_reduced(raster), MAX_PAGE_BYTES)
    part = usual if wanted.part is None else part_window(raster, wanted)
    cut = None if part is None else Cut(part, wanted.long_side_px)
    picture = draw(read_reduced(raster, part), cut)
    if wanted.part is None and scale is not None:
        picture = np.concatenate([picture, draw_vehicle_strip(raster, scale, picture.shape[1])])
    return small_jpeg(picture, side_px=wanted.long_side_px)


def scale_reply(
    raster: Raster | None, analysis: ScaleEvidence, wanted: PictureRequest, job: Job
) -> Reply[GsdEstimate]:
    """Combine the record of a scale with the requested picture; without one, the image need not be open."""
    from vehanchor.pictures.scale import draw_overlay
    from vehanchor_server.app_page.panel import drawing_of

    picture = None
    if raster is not None:
        picture = draw_picture(
            raster,
            job,
            wanted=wanted,
            draw=lambda seen, cut: draw_overlay(seen, analysis, cut),
            scale=analysis,
        )
    drawing = drawing_of(analysis) if wanted.kind == "plain" else None
    return Reply((analysis.estimate,), picture, drawing)


def part_window(raster: Raster, wanted: PictureRequest) -> Window:
    """Return the part that a picture shows, in whole pixels; all of the image without one.

    Raises:
        PromptError: the part is outside the image, or too small.
    """
    from vehanchor.imagery.raster import Window
    from vehanchor.options.reading import CoordinateFrame

    ends = wanted.part
    if ends is None:
        return Window(0, 0, width_px=raster.width_px, height_px=raster.height_px)
    coordinates = CoordinateFrame(wanted.frame, raster.width_px, raster.height_px)
    if not coordinates.inside(ends):
        numbers = ", ".join(f"{value:g}" for end in ends for value in end)
        raise PromptError(
            f"part {numbers} is not inside the {coordinates.name}{coordinates.other_reading(ends)}"
        )
    (left, top), (right, bottom) = (coordinates.in_image(*end) for end in ends)
    x = int(left)
    y = int(top)
    width = round(right) - x
    height = round(bottom) - y
    if min(width, height) < _LEAST_PART_PX:
        raise PromptError(
            f"the part is {width} x {height} px of the full image: give at least "
            f"{_LEAST_PART_PX} px per side"
            f"{coordinates.other_reading(ends)}"
        )
    return Window(x, y, width_px=width, height_px=height)
