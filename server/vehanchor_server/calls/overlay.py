"""The overlay as a picture small enough for every host, and the image itself for the page, which draws over it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple, cast

import cv2
import numpy as np

from vehanchor.pictures.scale import read_reduced

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster, Window
    from vehanchor_server.calls.answer import PictureRequest
    from vehanchor_server.calls.capacity import Stop
    from vehanchor_server.calls.job import Job

MAX_PICTURE_BYTES = 400_000  # hosts cap a result at about 0.75 MB: this and the page's picture, and base64 adds a third
MAX_PAGE_BYTES = 120_000  # on every result of a host that shows pages, whether anyone looks or not
MAX_SIDE_PX = 1568  # what vision models see at most; more would only cost
_QUALITIES = (85, 70, 55, 40)


class Pictures(NamedTuple):
    """Pictures of one image as JPEG; None where they were not wanted.

    Attributes:
        overlay: of at most ``MAX_PICTURE_BYTES``.
        page: of at most ``MAX_PAGE_BYTES``, with nothing drawn.
    """

    overlay: bytes | None = None
    page: bytes | None = None


def draw_pictures(
    raster: Raster, job: Job, wanted: PictureRequest, draw: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]
) -> Pictures:
    """Make the pictures of a result from one reading of the image.

    Args:
        raster: the image.
        job: is told of this stage, and ends the reading of a large image early.
        wanted: which.
        draw: makes the overlay, ``[h', w', 3]`` RGB, of the image or a reduced copy, ``[h, w, 3]``.
    """
    if not any(wanted):
        return Pictures()
    job.enter("overlay")
    seen = read_reduced(stoppable(raster, job.stop))
    page = small_jpeg(seen, MAX_PAGE_BYTES) if wanted.page else None
    return Pictures(small_jpeg(draw(seen)) if wanted.overlay else None, page)


def stoppable(raster: Raster, stop: Stop) -> Raster:
    """The same image, whose reading ends when the call is stopped."""
    return cast("Raster", _StoppableRaster(raster, stop))


def small_jpeg(picture: NDArray[np.uint8], max_bytes: int = MAX_PICTURE_BYTES) -> bytes:
    """A picture, ``[h, w, 3]`` RGB, as JPEG of at most so many bytes and ``MAX_SIDE_PX`` a side."""
    while True:
        picture = _within(picture, MAX_SIDE_PX)
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


class _StoppableRaster:
    """A raster whose reading ends when the call is stopped."""

    def __init__(self, raster: Raster, stop: Stop) -> None:
        self._raster = raster
        self._stop = stop

    def __getattr__(self, name: str) -> Any:
        return getattr(self._raster, name)

    def read(self, window: Window | None = None) -> NDArray[np.uint8]:
        self._stop.check()
        return self._raster.read(window)
