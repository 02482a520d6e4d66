"""The overlay as a picture small enough for every host."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import cv2
import numpy as np

from vehanchor.pictures.scale import read_reduced

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster, Window
    from vehanchor_server.calls.capacity import Stop

__all__ = ["MAX_PICTURE_BYTES", "MAX_SIDE_PX", "overlay_jpeg", "small_jpeg", "stoppable"]

MAX_PICTURE_BYTES = 500_000  # hosts cap a result at about 0.75 MB, and base64 adds a third
MAX_SIDE_PX = 1568  # what vision models see at most; more would only cost
_QUALITIES = (85, 70, 55, 40)


def overlay_jpeg(raster: Raster, stop: Stop, draw: Callable[[NDArray[np.uint8]], NDArray[np.uint8]]) -> bytes:
    """The picture that explains a result, as JPEG of at most ``MAX_PICTURE_BYTES``.

    Args:
        raster: the image.
        stop: ends the reading of a large image early.
        draw: makes the picture, ``[h', w', 3]`` RGB, of the image or a reduced copy, ``[h, w, 3]``.
    """
    return small_jpeg(draw(read_reduced(stoppable(raster, stop))))


def stoppable(raster: Raster, stop: Stop) -> Raster:
    """The same image, whose reading ends when the call is stopped."""
    return cast("Raster", _StoppableRaster(raster, stop))


def small_jpeg(picture: NDArray[np.uint8]) -> bytes:
    """A picture, ``[h, w, 3]`` RGB, as JPEG of at most ``MAX_PICTURE_BYTES`` and ``MAX_SIDE_PX`` a side."""
    while True:
        picture = _within(picture, MAX_SIDE_PX)
        for quality in _QUALITIES:
            _, encoded = cv2.imencode(".jpg", picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
            if encoded.size <= MAX_PICTURE_BYTES:
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
