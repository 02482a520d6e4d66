"""The tool ``view_image``: show an image with a coordinate grid or what a call saw, or list the images.

Models need it to give coordinates in an image that they know by path only, and to check vehicles
and masks. It has no structured content, because several hosts show a model nothing beside it. The
page has a tool of its own with the same work.
"""

# No postponed annotations here: the SDK reads the arguments' schema from them.

import os
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from itertools import groupby
from pathlib import PurePath
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BeforeValidator, Field
from pydantic_core import from_json

from vehanchor.options import Coordinates, Frame, Reading, declared_options
from vehanchor.options.option import Limits
from vehanchor.records.text import count
from vehanchor_server.app_page.page import PAGE_ONLY_META
from vehanchor_server.base_model import FrozenModel
from vehanchor_server.calls.call import run_call
from vehanchor_server.calls.job import Job
from vehanchor_server.calls.reply import PictureRequest, Reply
from vehanchor_server.calls.task import work
from vehanchor_server.images.argument import ImageArgument
from vehanchor_server.images.source import OpenedImage
from vehanchor_server.services import Services
from vehanchor_server.tools.picture import part_window
from vehanchor_server.tools.target import Box

if TYPE_CHECKING:
    from vehanchor_server.tools.strict_tool import CallToolResult, StrictTool

_DESCRIPTION = (
    "Shows an image, or a part of it, with a grid of pixel coordinates. View it before you give "
    "coordinates, and a "
    "part for precise ones. With of, shows what a call of another tool saw: numbered vehicles, "
    "masks, "
    "lines. Without both, lists the images."
)
_LEAST_SIDE_PX = 256
_USUAL_SIDE_PX = 1024
_LONGEST_SIDE_PX = 1568
_MAX_ENLARGEMENT = 4.0  # a larger one shows nothing more
_PART = {"x_min": 200, "y_min": 100, "x_max": 600, "y_max": 400}
_IMAGES_A_PAGE = 50

_Part = Annotated[Box | None, Field(description="Part to show; default all.", examples=[_PART])]
_Side = Annotated[int, Limits(_LEAST_SIDE_PX, _LONGEST_SIDE_PX, whole=True)]
_Page = Annotated[int, Limits(1, whole=True), Field(description="Page of the list.")]


def _read_json(value: Any) -> Any:
    """Read arguments that a client sends as text."""
    return from_json(value) if isinstance(value, str) else value


class PastCall(FrozenModel):
    """A call of a measuring tool."""

    tool: Literal["estimate_gsd", "measure_area", "measure_distance"]
    arguments: Annotated[dict[str, Any], BeforeValidator(_read_json)]


class ViewedImage(FrozenModel):
    """The displayed part of an image, its picture, and the spacing of the grid lines in pixels of the image."""

    image_width_px: int
    image_height_px: int
    part: Box
    picture_width_px: int
    picture_height_px: int
    grid_px: int


class PageImages(FrozenModel):
    """A page of the list of images; empty beside a picture."""

    images: tuple[str, ...] = Field(default=(), description="Paths.")
    next_page: int | None = Field(
        default=None, description="Number of the next page; null on the last."
    )


def view_image_tool(services: Services, measuring: "Mapping[str, StrictTool]") -> "StrictTool":
    """Create the tool for a server, with the tools whose calls it shows, by name."""
    from vehanchor_server.tools.strict_tool import CallToolResult, Context, StrictTool

    async def view_image(
        ctx: Context[Any, Any],
        image: ImageArgument | None = None,
        of: Annotated[
            PastCall | None, Field(description="Call to show, with its arguments.")
        ] = None,
        part: _Part = None,
        coordinates: Annotated[Coordinates, declared_options()["coordinates"].option] = "pixels",
        long_side_px: _Side = _USUAL_SIDE_PX,
        page: _Page = 1,
    ) -> CallToolResult:
        wanted = PictureRequest(
            "evidence",
            long_side_px,
            part=part.corners if part else None,
            frame=Frame(coordinates=coordinates),
        )
        if of is not None:
            named = {} if image is None else {"image": image.model_dump()}
            return await measuring[of.tool].show({**named, **of.arguments}, ctx, wanted)
        if image is None:
            names, total = await _list_images(services, page)
            return _with_picture(_list_in_words(names, total, page), None)
        seen = await run_call(services, ctx, image=image, work=_view, question=wanted)
        return _with_picture(_words(seen.record, long_side_px), seen.picture)

    return StrictTool.read_only(
        view_image,
        title="View an aerial image",
        description=_DESCRIPTION,
        kinds=services.settings.image_kinds,
    )


def page_image_tool(services: Services) -> "StrictTool":
    """Create the page's tool: an image without a grid, or the list of images, as data."""
    from vehanchor_server.tools.strict_tool import CallToolResult, Context, StrictTool

    async def page_image(
        ctx: Context[Any, Any],
        image: ImageArgument | None = None,
        part: _Part = None,
        long_side_px: _Side = _USUAL_SIDE_PX,
        page: _Page = 1,
    ) -> CallToolResult:
        if image is None:
            names, total = await _list_images(services, page)
            more = names and (page - 1) * _IMAGES_A_PAGE + len(names) < total
            listed = PageImages(images=tuple(names), next_page=page + 1 if more else None)
            picture = None
        else:
            seen = await run_call(
                services,
                ctx,
                image=image,
                work=_view,
                question=PictureRequest("plain", long_side_px, part.corners if part else None),
            )
            listed = PageImages()
            picture = seen.picture
        return _with_picture("For the page.", picture, listed.model_dump(mode="json"))

    return StrictTool.read_only(
        page_image,
        title="Show an image on the page",
        description="For the page of this server; models use view_image.",
        meta=PAGE_ONLY_META,
        record=PageImages,
        answered=("images",),
        kinds=services.settings.image_kinds,
    )


def _with_picture(
    words: str, jpeg: bytes | None, data: dict[str, Any] | None = None
) -> "CallToolResult":
    from mcp.server.mcpserver import Image
    from mcp.types import CallToolResult, TextContent

    content: list[Any] = [TextContent(type="text", text=words)]
    if jpeg is not None:
        content.append(Image(data=jpeg, format="jpeg").to_image_content())
    return CallToolResult(content=content, structured_content=data)


async def _list_images(services: Services, page: int) -> tuple[list[str], int]:
    """Return the names on a page of the list, and the number of all images."""
    first = (page - 1) * _IMAGES_A_PAGE
    listed = services.sources.paths.listed
    return await services.capacity.run(
        lambda stop: services.capacity.in_thread(stop, partial(listed, first, _IMAGES_A_PAGE, stop))
    )


def _list_in_words(names: Sequence[str], total: int, page: int) -> str:
    head = count(total, "image")
    if len(names) < total:
        first = (page - 1) * _IMAGES_A_PAGE
        shown = f"{first + 1} to {first + len(names)}" if names else "none"
        head += f", {shown} on page {page} of {-(-total // _IMAGES_A_PAGE)}"
    return "\n".join([f"{head}{':' if names else '.'}", *_by_folder(names)])


def _by_folder(paths: Iterable[str]) -> list[str]:
    """List each folder once, followed by its files, indented."""
    lines = []
    for folder, found in groupby(map(PurePath, paths), lambda path: path.parent):
        lines += [f"{folder}{os.sep}", *(f"  {path.name}" for path in found)]
    return lines


@work(ViewedImage)
def _view(
    services: Services, job: Job, source: OpenedImage, wanted: PictureRequest
) -> Reply[ViewedImage]:
    """Draw the picture; a plain one has no grid."""
    import cv2
    import numpy as np

    from vehanchor.imagery.sources.opening import open_raster
    from vehanchor.pictures.grid import draw_grid
    from vehanchor_server.calls.jpeg import small_jpeg

    job.stop.check()
    reading = Reading(limits=services.settings.image_limits)
    with open_raster(source, reading) as raster:
        window = part_window(raster, wanted)
        job.stop.check()
        rgb, step_px = draw_grid(
            raster,
            window,
            long_side_px=wanted.long_side_px,
            max_enlargement=_MAX_ENLARGEMENT,
            lines=wanted.kind == "evidence",
        )
        jpeg = small_jpeg(rgb)
        shown = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert shown is not None
        height, width = shown.shape[:2]  # small_jpeg may have reduced the picture
        right = window.x_px + window.width_px
        bottom = window.y_px + window.height_px
        seen = ViewedImage(
            image_width_px=raster.width_px,
            image_height_px=raster.height_px,
            part=Box(x_min=window.x_px, y_min=window.y_px, x_max=right, y_max=bottom),
            picture_width_px=width,
            picture_height_px=height,
            grid_px=step_px,
        )
    return Reply((seen,), jpeg)


def _words(seen: ViewedImage, long_side_px: int) -> str:
    part = seen.part
    size = f"{seen.picture_width_px} x {seen.picture_height_px}"
    factor = (part.x_max - part.x_min) / seen.picture_width_px
    words = (
        f"Image of {seen.image_width_px} x {seen.image_height_px} px. The picture of {size} "
        "px shows "
    )
    if (part.x_max - part.x_min, part.y_max - part.y_min) == (
        seen.image_width_px,
        seen.image_height_px,
    ):
        words += "all of it: give that size as frame if you use the picture's pixels"
    else:
        words += (
            f"x {part.x_min:.0f} to {part.x_max:.0f}, y {part.y_min:.0f} to {part.y_max:.0f}: "
            "in the image, "
            f"x = {part.x_min:.0f} + {factor:.4g} * column, y = {part.y_min:.0f} + {factor:.4g} "
            "* row"
        )
    if max(seen.picture_width_px, seen.picture_height_px) < long_side_px - 1:
        limit = (
            f"enlarged {_MAX_ENLARGEMENT:g} times, the most"
            if factor < 1
            else "as large as a result may be"
        )
        words += f". It is smaller than the {long_side_px} px asked for: it is {limit}"
    return (
        f"{words}. Grid lines are {seen.grid_px} image pixels apart and numbered in image pixels."
    )
