"""The tool ``view_image``: show an image with a grid, show what a call saw, or list the images.

Models need it to give coordinates in an image that they know by path only, and to check vehicles
and masks. It has no structured content, because several hosts show a model nothing beside it. The
page has a tool of its own with the same work.
"""

# No postponed annotations here: the SDK reads the arguments' schema from them.

import os
from collections.abc import Iterable, Mapping
from itertools import groupby
from pathlib import PurePath
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from pydantic import BeforeValidator, Field
from pydantic_core import from_json

from vehanchor.options import Coordinates, Frame, Reading, declared_options
from vehanchor.options.option import Limits
from vehanchor.options.reading import MAX_VIEW_ENLARGEMENT, VIEWED_SIDE_PX
from vehanchor.records.gsd_estimate import PixelAspect
from vehanchor.records.text import count
from vehanchor_server.app_page.page import PAGE_ONLY_META
from vehanchor_server.base_model import FrozenModel
from vehanchor_server.calls.capacity import Stop
from vehanchor_server.calls.client import current_client
from vehanchor_server.calls.job import Job
from vehanchor_server.calls.reply import PictureRequest, Reply
from vehanchor_server.calls.task import work
from vehanchor_server.errors import CallError
from vehanchor_server.images.argument import ImageArgument
from vehanchor_server.images.source import OpenedImage
from vehanchor_server.resources import Resources
from vehanchor_server.services import Services
from vehanchor_server.tools.picture import part_window
from vehanchor_server.tools.target import Box

if TYPE_CHECKING:
    from vehanchor.imagery.raster import Window
    from vehanchor_server.tools.strict_tool import CallToolResult, StrictTool

_DESCRIPTION = (
    "Shows an image, or a part of it, with a grid of pixel coordinates. View the image before you "
    "give coordinates, and a part of it for precise ones. With of, it shows what a call of another "
    "tool saw: numbered vehicles, masks, lines. Without image and of, it lists the images."
)
_MIN_SIDE_PX = 256
_MAX_SIDE_PX = 1568
_EXAMPLE_PART = {"x_min": 200, "y_min": 100, "x_max": 600, "y_max": 400}
_IMAGES_PER_PAGE = 50

_Part = Annotated[
    Box | None,
    Field(description="Part to show. Default: all of it.", examples=[_EXAMPLE_PART]),
]
_Side = Annotated[int, Limits(_MIN_SIDE_PX, _MAX_SIDE_PX, whole=True)]
_Page = Annotated[int, Limits(1, whole=True), Field(description="Page of the list.")]


def _read_json(value: Any) -> Any:
    """Read arguments that a client sends as text."""
    if isinstance(value, str):
        return from_json(value)
    return value


class PastCall(FrozenModel):
    """A call of a measuring tool."""

    tool: Literal["estimate_gsd", "measure_area", "measure_distance"]
    arguments: Annotated[dict[str, Any], BeforeValidator(_read_json)]


class ViewedImage(FrozenModel):
    """The displayed part of an image and its picture.

    Attributes:
        image_width_px: width of the whole image.
        image_height_px: height of the whole image.
        part: the displayed part, in pixels of the image.
        picture_width_px: width of the picture.
        picture_height_px: height of the picture.
        grid_px: spacing of the grid lines, in pixels of the image.
        pixel_aspect: height of a pixel of the image over its width on the ground; the picture's
            pixels are square. None for square pixels.
    """

    image_width_px: int
    image_height_px: int
    part: Box
    picture_width_px: int
    picture_height_px: int
    grid_px: int
    pixel_aspect: PixelAspect = None


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
            PastCall | None,
            Field(description="Call of another tool to show."),
        ] = None,
        part: _Part = None,
        coordinates: Annotated[Coordinates, declared_options()["coordinates"].option] = "pixels",
        long_side_px: _Side = VIEWED_SIDE_PX,
        page: _Page = 1,
        known_sizes: Annotated[
            bool, Field(description="List the names for known_lengths.")
        ] = False,
    ) -> CallToolResult:
        if known_sizes:
            return _with_picture(_known_sizes_in_words(), None)
        request = PictureRequest(
            "evidence",
            long_side_px,
            part=part.corners if part else None,
            frame=Frame(coordinates=coordinates),
        )
        if of is not None:
            arguments = of.arguments
            if image is not None:
                arguments = {"image": image.model_dump(), **arguments}
            return await measuring[of.tool].show(arguments, ctx, request)
        if image is None:
            listing = await _list_images(services, page)
            return _with_picture(_listing_in_words(listing), None)
        reply = await services.run_call(ctx, image, work=_view, question=request)
        return _with_picture(_words(reply.record, long_side_px), reply.picture)

    return StrictTool.read_only(
        view_image,
        title="View an aerial image",
        description=_DESCRIPTION,
        image_kinds=services.resources.settings.image_kinds,
    )


def page_image_tool(services: Services) -> "StrictTool":
    """Create the page's tool: an image without a grid, or the list of images, as data."""
    from vehanchor_server.tools.strict_tool import CallToolResult, Context, StrictTool

    async def page_image(
        ctx: Context[Any, Any],
        image: ImageArgument | None = None,
        part: _Part = None,
        long_side_px: _Side = VIEWED_SIDE_PX,
        page: _Page = 1,
    ) -> CallToolResult:
        if image is None:
            listing = await _list_images(services, page)
            record = PageImages(images=tuple(listing.names), next_page=listing.next_page)
            picture = None
        else:
            corners = part.corners if part else None
            request = PictureRequest("plain", long_side_px, part=corners)
            reply = await services.run_call(ctx, image, work=_view, question=request)
            record = PageImages()
            picture = reply.picture
        return _with_picture("For the page.", picture, data=record.model_dump(mode="json"))

    return StrictTool.read_only(
        page_image,
        title="Show an image on the page",
        description="For the page of this server; models use view_image.",
        meta=PAGE_ONLY_META,
        record=PageImages,
        listed_fields=("images",),
        image_kinds=services.resources.settings.image_kinds,
    )


def _with_picture(
    text: str, jpeg: bytes | None, data: dict[str, Any] | None = None
) -> "CallToolResult":
    from mcp.server.mcpserver import Image
    from mcp.types import CallToolResult, TextContent

    content: list[Any] = [TextContent(type="text", text=text)]
    if jpeg is not None:
        content.append(Image(data=jpeg, format="jpeg").to_image_content())
    return CallToolResult(content=content, structured_content=data)


class _Listing(NamedTuple):
    """A page of the list of images.

    Attributes:
        names: paths of its images.
        first: number of images on earlier pages.
        total: number of all images.
        page: number of the page, from 1.
    """

    names: list[str]
    first: int
    total: int
    page: int

    @property
    def n_pages(self) -> int:
        """Number of pages, at least one."""
        full_or_begun = -(-self.total // _IMAGES_PER_PAGE)  # rounded up
        return max(1, full_or_begun)

    @property
    def next_page(self) -> int | None:
        """Number of the next page; None on the last."""
        is_last = not self.names or self.first + len(self.names) >= self.total
        return None if is_last else self.page + 1


async def _list_images(services: Services, page: int) -> _Listing:
    """List the images on a page; the walk over the files takes a slot and has the deadline."""
    first = (page - 1) * _IMAGES_PER_PAGE
    paths = services.resources.sources.paths

    async def call(stop: Stop) -> tuple[list[str], int]:
        def walk() -> tuple[list[str], int]:
            return paths.listed(first, _IMAGES_PER_PAGE, stop.check)

        return await services.capacity.in_thread(stop, walk)

    names, total = await services.capacity.run(call, current_client())
    listing = _Listing(names, first, total=total, page=page)
    if page > listing.n_pages:
        raise CallError(
            "invalid_arguments",
            f"page is {page}, but the list of {count(total, 'image')} ends at page "
            f"{listing.n_pages}.",
        )
    return listing


def _listing_in_words(listing: _Listing) -> str:
    names = listing.names
    head = count(listing.total, "image")
    if len(names) < listing.total:
        shown = f"{listing.first + 1} to {listing.first + len(names)}"
        head += f", {shown} on page {listing.page} of {listing.n_pages}"
    head += ":" if names else "."
    return "\n".join([head, *_by_folder(names)])


def _known_sizes_in_words() -> str:
    """List the things of known size: the ends of the line to draw, and their lengths."""
    from vehanchor.rulers.standards import describe_lengths, standards

    lines = [
        "Things of known size for known_lengths: name, the two ends of the line, lengths with "
        "their spread and countries. A line may span equal things in a row, such as "
        '"9 x parking_bay_width"; a country is added as in "railway_gauge/ES".'
    ]
    for standard in standards().values():
        lengths = "; ".join(describe_lengths(standard))
        lines.append(f"{standard.name}: {standard.between}. {lengths}.")
    return "\n".join(lines)


def _by_folder(paths: Iterable[str]) -> list[str]:
    """List each folder once, followed by its files, indented."""
    lines = []
    for folder, files in groupby(map(PurePath, paths), lambda path: path.parent):
        lines.append(f"{folder}{os.sep}")
        lines += [f"  {path.name}" for path in files]
    return lines


@work(ViewedImage)
def _view(
    resources: Resources, job: Job, source: OpenedImage, request: PictureRequest
) -> Reply[ViewedImage]:
    """Draw the picture; a plain one has no grid."""
    import cv2
    import numpy as np

    from vehanchor.imagery.sources.opening import open_raster
    from vehanchor.pictures.grid import draw_grid, window_in_file
    from vehanchor_server.calls.jpeg import small_jpeg

    job.stop.check()
    reading = Reading(limits=resources.settings.image_limits)
    with open_raster(source, reading) as raster:
        window = part_window(raster, request)
        job.stop.check()
        rgb, step_px = draw_grid(
            raster,
            window,
            long_side_px=request.long_side_px,
            max_enlargement=_max_enlargement(window, request),
            lines=request.kind == "evidence",
        )
        jpeg = small_jpeg(rgb)
        # small_jpeg may have reduced the picture, and a model needs its true size.
        decoded = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
        assert decoded is not None
        height, width = decoded.shape[:2]
        corners = window_in_file(window, raster.grid)
        x_min, y_min, x_max, y_max = np.round(corners, 2).tolist()
        part = Box(x_min=x_min, y_min=y_min, x_max=x_max, y_max=y_max)
        viewed = ViewedImage(
            image_width_px=raster.grid.width_px,
            image_height_px=raster.grid.height_px,
            part=part,
            picture_width_px=width,
            picture_height_px=height,
            grid_px=step_px,
            pixel_aspect=raster.grid.stated_aspect,
        )
    return Reply((viewed,), jpeg)


def _max_enlargement(window: "Window", request: PictureRequest) -> float:
    """Return the largest enlargement: of a small part, as much as it takes to see it."""
    from vehanchor.pictures.placement import MIN_PART_SIDE_PX

    if request.part is None:
        return MAX_VIEW_ENLARGEMENT
    long_side = max(window.width_px, window.height_px)
    return max(MAX_VIEW_ENLARGEMENT, MIN_PART_SIDE_PX / long_side)


def _frame_of_part(viewed: ViewedImage, factor: float) -> str:
    """Describe the copy of the whole image that has the pixels of the displayed part.

    A box in the pixels of that copy is as exact as it was seen: its error follows the frame.

    Args:
        viewed: a part.
        factor: pixels of the image per pixel of the picture.
    """
    width = round(viewed.image_width_px / factor)
    height = round(width * viewed.image_height_px / viewed.image_width_px)
    return (
        f"; in a frame of {width} x {height} px, x = {viewed.part.x_min / factor:.0f} + column, "
        f"y = {viewed.part.y_min / factor:.0f} + row"
    )


def _words(viewed: ViewedImage, long_side_px: int) -> str:
    """Describe a picture to a model, with the conversion of its pixels to those of the image."""
    part = viewed.part
    part_width = part.x_max - part.x_min
    part_height = part.y_max - part.y_min
    factor = part_width / viewed.picture_width_px
    factor_down = factor
    if viewed.pixel_aspect is not None:
        factor_down = part_height / viewed.picture_height_px
    words = (
        f"Image of {viewed.image_width_px} x {viewed.image_height_px} px. The picture of "
        f"{viewed.picture_width_px} x {viewed.picture_height_px} px shows "
    )
    if (part_width, part_height) == (viewed.image_width_px, viewed.image_height_px):
        words += "all of it: give that size as frame if you use the picture's pixels"
    else:
        words += (
            f"x {part.x_min:.0f} to {part.x_max:.0f}, y {part.y_min:.0f} to {part.y_max:.0f}: "
            f"in the image, x = {part.x_min:.0f} + {factor:.4g} * column, "
            f"y = {part.y_min:.0f} + {factor_down:.4g} * row"
        )
        if viewed.pixel_aspect is None:
            words += _frame_of_part(viewed, factor)
    # One pixel may be missing by rounding.
    if max(viewed.picture_width_px, viewed.picture_height_px) < long_side_px - 1:
        reason = "as large as a result may be"
        if factor < 1:
            reason = f"enlarged {1 / factor:.3g} times, the most"
        words += f". It is smaller than the {long_side_px} px asked for: it is {reason}"
    return (
        f"{words}. Grid lines are {viewed.grid_px} image pixels apart and numbered in image pixels."
    )
