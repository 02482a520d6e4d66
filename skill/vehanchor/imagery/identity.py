"""Image identity: a checksum of the pixels, equal for a path, its bytes and its array."""

from __future__ import annotations

import hashlib
from typing import TYPE_CHECKING

from vehanchor.imagery.raster import Window

if TYPE_CHECKING:
    from vehanchor.imagery.raster import Raster

_WINDOWS_PER_SIDE = 8
_WINDOW_PX = 512  # 8 x 8 windows cover 4096 x 4096 px
_DIGITS = 16


def image_id(raster: Raster) -> str:
    """Hash size and pixels to 16 hexadecimal digits; above 4096 px per side, hash 64 evenly spaced windows."""
    digest = hashlib.sha256(f"{raster.width_px} x {raster.height_px}".encode())
    rows, columns = _spans(raster.height_px), _spans(raster.width_px)
    for y, height in rows:
        for x, width in columns:
            digest.update(raster.read(Window(x, y, width, height)).data)
    return digest.hexdigest()[:_DIGITS]


def _spans(side_px: int) -> list[tuple[int, int]]:
    """Compute the start and length of each window along a side."""
    step = max(_WINDOW_PX, -(-side_px // _WINDOWS_PER_SIDE))
    return [(start, min(_WINDOW_PX, side_px - start)) for start in range(0, side_px, step)]
