"""What tells one image from another: a checksum of its pixels, however it was handed over."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

from vehanchor.imagery.raster import Window

if TYPE_CHECKING:
    from vehanchor.imagery.raster import Raster

_WINDOWS_A_SIDE = 8
_WINDOW_PX = 512  # 8 x 8 of them are all of an image of 4096 px a side
_DIGITS = 16


def image_id(raster: Raster) -> str:
    """Sum up size and pixels; of an image above 4096 px a side, 64 windows spread evenly over it.

    Args:
        raster: the image; a path, its bytes and its array have the same sum.

    Returns:
        16 hexadecimal digits.
    """
    digest = hashlib.sha256(f"{raster.width_px} x {raster.height_px}".encode())
    rows, columns = _spans(raster.height_px), _spans(raster.width_px)
    for y, height in rows:
        for x, width in columns:
            digest.update(raster.read(Window(x, y, width, height)).data)
    return digest.hexdigest()[:_DIGITS]


def _spans(side_px: int) -> list[tuple[int, int]]:
    """Where windows begin along a side, and how long they are."""
    step = max(_WINDOW_PX, -(-side_px // _WINDOWS_A_SIDE))
    return [(start, min(_WINDOW_PX, side_px - start)) for start in range(0, side_px, step)]
