"""Encode the overlay and the page's image as JPEGs that are small enough for all hosts."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, cast

import cv2
import numpy as np

from vehanchor.pictures.scale import read_reduced
from vehanchor_server.calls.reply import MAX_SIDE_PX

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster, Window
    from vehanchor_server.calls.job import Job
    from vehanchor_server.calls.reply import PictureRequest

MAX_PICTURE_BYTES = 400_000  # hosts cap a result at about 0.75 MB: this and the page's picture, and base64 adds a third
MAX_PAGE_BYTES = 120_000  # part of every result of a host with pages
_QUALITIES = (85, 70, 55, 40)


class Pictures(NamedTuple):
    """JPEGs of one image; None if not requested.

    Attributes:
        overlay: at most ``MAX_PICTURE_BYTES``.
        page: the plain image, at most ``MAX_PAGE_BYTES``.
    """

    overlay: bytes | None = None
    page: bytes | None = None


def draw_pictures(
    raster: Raster,
    job: Job,
    wanted: PictureRequest,
    draw: Callable[[NDArray[np.uint8]], NDArray[np.uint8]],
    part: Window | None = None,
) -> Pictures:
    """Make the requested pictures.

    Args:
        raster: the image.
        job: can stop before the reading.
        wanted: the requested pictures.
        draw: draws the overlay, ``[h', w', 3]`` RGB, on the image, its part or a reduced copy, ``[h, w, 3]``.
        part: the part that the overlay shows; None for all of the image.
    """
    if not (wanted.overlay or wanted.page):
        return Pictures()
    job.stop.check()
    whole = read_reduced(raster) if wanted.page or part is None else None
    page = small_jpeg(whole, MAX_PAGE_BYTES) if whole is not None and wanted.page else None
    if not wanted.overlay:
        return Pictures(None, page)
    seen = whole if whole is not None and part is None else read_reduced(raster, part)
    return Pictures(small_jpeg(draw(seen), side_px=wanted.long_side_px), page)


def small_jpeg(picture: NDArray[np.uint8], max_bytes: int = MAX_PICTURE_BYTES, side_px: int = MAX_SIDE_PX) -> bytes:
    """Encode a picture, ``[h, w, 3]`` RGB, as JPEG within the limits of bytes and of its longer side."""
    while True:
        picture = _within(picture, side_px)
        for quality in _QUALITIES:
            _, encoded = cv2.imencode(".jpg", picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
            if encoded.size <= max_bytes:
                return encoded.tobytes()
        picture = _within(picture, max(picture.shape[:2]) * 2 // 3)


def _within(picture: NDArray[np.uint8], side_px: int) -> NDArray[np.uint8]:
    height, width = picture.shape[:2]
    factor = side_px / max(height, width)
    if factor >= 1:
        return picture
    size = max(1, round(width * factor)), max(1, round(height * factor))
    return cast("NDArray[np.uint8]", cv2.resize(picture, size, interpolation=cv2.INTER_AREA))
