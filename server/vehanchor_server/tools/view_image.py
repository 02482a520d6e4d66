"""The tool ``view_image``: show an image with a coordinate grid, or list the images.

Models need it to give coordinates in an image that they know by path only.
"""

# No postponed annotations here: the SDK reads the result's schema from them.

import os
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import PurePath
from typing import Annotated, Any

from mcp.server.mcpserver import Context, Image
from mcp.types import CallToolResult, TextContent
from pydantic import Field

from vehanchor.errors import PromptError
from vehanchor.options import Coordinates, Frame, Reading, declared_options
from vehanchor.options.option import Limits
from vehanchor_server.calls.call import run_call
from vehanchor_server.calls.capacity import Stop
from vehanchor_server.calls.job import Job
from vehanchor_server.calls.reply import Reply
from vehanchor_server.calls.task import work
from vehanchor_server.frozen import Flag, FrozenModel
from vehanchor_server.images.argument import ImageArgument
from vehanchor_server.images.source import OpenedImage
from vehanchor_server.services import Services
from vehanchor_server.tools.portable_schema import Listing
from vehanchor_server.tools.strict_tool import StrictTool
from vehanchor_server.tools.target import Box

_DESCRIPTION = (
    "Shows an image, or a part of it, with a grid of pixel coordinates. View the image before you give coordinates, "
    "and a part of it for precise ones. Without image, lists the available images. It measures nothing."
)
_LEAST_SIDE_PX, _USUAL_SIDE_PX, _LONGEST_SIDE_PX = 256, 1024, 1568
_LEAST_PART_PX = 16
_MAX_ENLARGEMENT = 4.0  # a larger one shows nothing more
_PART = {"x_min": 200, "y_min": 100, "x_max": 600, "y_max": 400}
_IMAGES_A_PAGE = 50
_LAST_PAGE = 2000


class ViewedImage(FrozenModel):
    """The displayed part of an image, or a list of images."""

    image_width_px: int | None = Field(default=None, description="Width of the full image, pixels.")
    image_height_px: int | None = Field(default=None, description="Height of the full image, pixels.")
    part: Box | None = Field(default=None, description="The displayed part, pixels of the full image.")
    picture_width_px: int | None = Field(default=None, description="Width of the picture, pixels.")
    picture_height_px: int | None = Field(default=None, description="Height of the picture, pixels.")
    grid_px: int | None = Field(default=None, description="Spacing of the grid lines, pixels of the full image.")
    images: tuple[str, ...] | None = Field(default=None, description="Paths, if no image was given.")
    images_total: int | None = Field(default=None, description="Number of all images, if no image was given.")
    next_page: int | None = Field(default=None, description="Number of the next page; null on the last.")


@dataclass(frozen=True)
class _ViewRequest:
    """Arguments of a call."""

    part: Box | None
    coordinates: Coordinates
    long_side_px: int
    grid: bool


def view_image_tool(services: Services) -> StrictTool:
    """Create the tool for a server."""

    async def view_image(
        ctx: Context[Any, Any],
        image: ImageArgument | None = None,
        part: Annotated[Box | None, Field(description="Part to show; default all.", examples=[_PART])] = None,
        coordinates: Annotated[Coordinates, declared_options()["coordinates"].option] = "pixels",
        long_side_px: Annotated[int, Limits(_LEAST_SIDE_PX, _LONGEST_SIDE_PX, whole=True)] = _USUAL_SIDE_PX,
        page: Annotated[int, Limits(1, _LAST_PAGE, whole=True), Field(description="Page of the list.")] = 1,
        grid: Annotated[Flag, Field(description="Draw the grid; people who click need none.")] = True,
    ) -> Annotated[CallToolResult, ViewedImage]:
        if image is None:
            return await _list_images(services, page)
        request = _ViewRequest(part, coordinates, long_side_px, grid)
        answer = await run_call(services, ctx, image, _view, request)
        return _result(_words(answer.record, long_side_px), answer.record, answer.overlay)

    return StrictTool.read_only(
        view_image,
        title="View an aerial image",
        description=_DESCRIPTION,
        answered=("grid_px", "images"),
        listing=Listing(("grid",), services.settings.image_kinds),
    )


async def _list_images(services: Services, page: int) -> CallToolResult:
    first = (page - 1) * _IMAGES_A_PAGE

    async def call(stop: Stop) -> tuple[list[str], int]:
        return await services.capacity.in_thread(
            stop, partial(services.sources.paths.listed, first, _IMAGES_A_PAGE, stop)
        )

    names, total = await services.capacity.run(call)
    more = first + len(names) < total and bool(names)
    listed = ViewedImage(images=tuple(names), images_total=total, next_page=page + 1 if more else None)
    head = f"{total} image{'' if total == 1 else 's'}"
    if len(names) < total:
        shown = f"{first + 1} to {first + len(names)}" if names else "none"
        head += f", {shown} on page {page} of {-(-total // _IMAGES_A_PAGE)}"
    head += ":" if names else "."
    return _result("\n".join([head, *_by_folder(names)]), listed, None)


def _by_folder(paths: Iterable[str]) -> list[str]:
    """List each folder once, followed by its files, indented."""
    lines = []
    for folder, found in groupby(map(PurePath, paths), lambda path: path.parent):
        lines += [f"{folder}{os.sep}", *(f"  {path.name}" for path in found)]
    return lines


def _result(words: str, seen: ViewedImage, jpeg: bytes | None) -> CallToolResult:
    content: list[Any] = [TextContent(type="text", text=words)]
    if jpeg is not None:
        content.append(Image(data=jpeg, format="jpeg").to_image_content())
    return CallToolResult(content=content, structured_content=seen.model_dump(mode="json", exclude_none=True))


@work(ViewedImage)
def _view(services: Services, job: Job, source: OpenedImage, request: _ViewRequest) -> Reply[ViewedImage]:
    """Draw the picture, in a worker process or thread.

    Raises:
        VehAnchorError: the library refused the image or an option.
        CallStoppedError: the call was stopped.
    """
    import cv2

    from vehanchor.imagery.raster import Window
    from vehanchor.imagery.sources.opening import open_raster
    from vehanchor.options.reading import CoordinateFrame
    from vehanchor.pictures.grid import draw_grid
    from vehanchor_server.calls.overlay import small_jpeg

    job.stop.check()
    reading = Reading(limits=services.settings.image_limits)
    with open_raster(source, limits=reading.limits) as raster:
        window = Window(0, 0, raster.width_px, raster.height_px)
        if request.part is not None:
            coordinates = CoordinateFrame(Frame(coordinates=request.coordinates), raster.width_px, raster.height_px)
            window = Window(*_inside(request.part, coordinates))
        job.stop.check()
        picture = draw_grid(raster, window, request.long_side_px, _MAX_ENLARGEMENT, request.grid)
        jpeg = small_jpeg(picture.rgb)
        shown = cv2.imdecode(_bytes(jpeg), cv2.IMREAD_COLOR)
        assert shown is not None
        height, width = shown.shape[:2]  # small_jpeg may have reduced the picture
        seen = ViewedImage(
            image_width_px=raster.width_px,
            image_height_px=raster.height_px,
            part=Box(
                x_min=window.x_px,
                y_min=window.y_px,
                x_max=window.x_px + window.width_px,
                y_max=window.y_px + window.height_px,
            ),
            picture_width_px=width,
            picture_height_px=height,
            grid_px=picture.step_px,
        )
    return Reply((seen,), jpeg)


def _bytes(jpeg: bytes) -> Any:
    import numpy as np

    return np.frombuffer(jpeg, np.uint8)


def _inside(part: Box, coordinates: Any) -> tuple[int, int, int, int]:
    """Return the part's first column and row, width and height, in whole pixels.

    Raises:
        PromptError: the part is outside the image, or too small.
    """
    ends = ((part.x_min, part.y_min), (part.x_max, part.y_max))
    if not coordinates.inside(ends):
        numbers = ", ".join(f"{value:g}" for end in ends for value in end)
        raise PromptError(f"part {numbers} is not inside the {coordinates.name}{coordinates.other_reading(ends)}")
    (left, top), (right, bottom) = (coordinates.in_image(end) for end in ends)
    x, y = int(left), int(top)
    width, height = round(right) - x, round(bottom) - y
    if min(width, height) < _LEAST_PART_PX:
        raise PromptError(
            f"the part is {width} x {height} px of the full image: give at least {_LEAST_PART_PX} px per side"
            f"{coordinates.other_reading(ends)}"
        )
    return x, y, width, height


def _words(seen: ViewedImage, long_side_px: int) -> str:
    assert seen.part is not None
    part, size = seen.part, f"{seen.picture_width_px} x {seen.picture_height_px}"
    assert seen.picture_width_px is not None
    assert seen.picture_height_px is not None
    factor = (part.x_max - part.x_min) / seen.picture_width_px
    words = f"Image of {seen.image_width_px} x {seen.image_height_px} px. "
    whole = (part.x_max - part.x_min, part.y_max - part.y_min) == (seen.image_width_px, seen.image_height_px)
    if whole:
        words += f"The picture of {size} px shows all of it: give that size as frame if you use the picture's pixels"
    else:
        words += (
            f"The picture of {size} px shows x {part.x_min:.0f} to {part.x_max:.0f}, y {part.y_min:.0f} to "
            f"{part.y_max:.0f}: in the image, x = {part.x_min:.0f} + {factor:.4g} * column, "
            f"y = {part.y_min:.0f} + {factor:.4g} * row"
        )
    if max(seen.picture_width_px, seen.picture_height_px) < long_side_px - 1:
        limit = f"enlarged {_MAX_ENLARGEMENT:g} times, the most" if factor < 1 else "as large as a result may be"
        words += f". It is smaller than the {long_side_px} px asked for: it is {limit}"
    return f"{words}. Grid lines are {seen.grid_px} image pixels apart and numbered in image pixels."
