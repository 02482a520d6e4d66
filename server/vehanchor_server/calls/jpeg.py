"""Encode pictures as JPEGs that are small enough for all hosts."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import cv2
import numpy as np

from vehanchor_server.calls.reply import MAX_SIDE_PX

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAX_PICTURE_BYTES = 400_000  # hosts cap a result at about 0.75 MB, and base64 adds a third
MAX_PAGE_BYTES = 120_000  # part of every result of a host with pages
_QUALITIES = (85, 70, 55, 40)


def small_jpeg(
    picture: NDArray[np.uint8], max_bytes: int = MAX_PICTURE_BYTES, side_px: int = MAX_SIDE_PX
) -> bytes:
    """Encode a picture, ``[h, w, 3]`` RGB, as JPEG within the limits of bytes and of its longer side."""
    while True:
        picture = _within(picture, side_px)
        for quality in _QUALITIES:
            _, encoded = cv2.imencode(
                ".jpg", picture[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality]
            )
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
