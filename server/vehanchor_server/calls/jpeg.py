"""Encode pictures as JPEGs that are small enough for all hosts."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import cv2
import numpy as np

from vehanchor_server.calls.reply import MAX_SIDE_PX

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAX_PICTURE_BYTES = 400_000  # hosts cap a result at about 0.75 MB, and base64 adds a third
MAX_PAGE_BYTES = 120_000  # every result of a host with pages has such a picture
_QUALITIES = (85, 70, 55, 40)


def small_jpeg(
    picture: NDArray[np.uint8], max_bytes: int = MAX_PICTURE_BYTES, side_px: int = MAX_SIDE_PX
) -> bytes:
    """Encode a picture as JPEG within limits.

    Args:
        picture: ``[h, w, 3]`` RGB.
        max_bytes: largest size of the JPEG.
        side_px: longest side of the JPEG.
    """
    # A lower quality first, then a smaller picture: until it fits.
    while True:
        picture = _within(picture, side_px)
        for quality in _QUALITIES:
            options = [cv2.IMWRITE_JPEG_QUALITY, quality]
            _, encoded = cv2.imencode(".jpg", picture[:, :, ::-1], options)
            if encoded.size <= max_bytes:
                return encoded.tobytes()
        longer_side = max(picture.shape[:2])
        picture = _within(picture, longer_side * 2 // 3)


def _within(picture: NDArray[np.uint8], side_px: int) -> NDArray[np.uint8]:
    """Reduce a picture whose longer side is above a limit."""
    height, width = picture.shape[:2]
    factor = side_px / max(height, width)
    if factor >= 1:
        return picture
    reduced_width = max(1, round(width * factor))
    reduced_height = max(1, round(height * factor))
    reduced = cv2.resize(picture, (reduced_width, reduced_height), interpolation=cv2.INTER_AREA)
    return cast("NDArray[np.uint8]", reduced)
