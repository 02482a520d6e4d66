"""Image identity: a checksum of the image, equal for a path and its bytes.

Up to 4096 px per side, and for every image that is decoded whole, the checksum covers all pixels,
so that it equals that of the array. For a larger image that is read by windows it covers 64 windows
and the encoded file.
"""

from __future__ import annotations

import hashlib
import os
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

from vehanchor.errors import ImageDecodeError
from vehanchor.imagery.raster import Window

if TYPE_CHECKING:
    from vehanchor.imagery.raster import Raster

_WINDOWS_PER_SIDE = 8
_WINDOW_PX = 512  # 8 x 8 windows cover 4096 x 4096 px
_DIGITS = 16
_BLOCKS = 512
_BLOCK_BYTES = 1 << 20


def image_id(raster: Raster) -> str:
    """Hash size and content to 16 hexadecimal digits.

    Of a file of more than 512 MiB that is read by windows, 512 evenly spaced blocks of 1 MiB count;
    of the caller's rasterio dataset the windows alone.
    """
    if raster.known_id:
        return raster.known_id
    digest = hashlib.sha256(f"{raster.width_px} x {raster.height_px}".encode())
    step = _WINDOW_PX if raster.in_memory else None
    rows = _spans(raster.height_px, step)
    columns = _spans(raster.width_px, step)
    if (
        not raster.in_memory
        and max(raster.width_px, raster.height_px) > _WINDOWS_PER_SIDE * _WINDOW_PX
    ):
        _update_with_file(digest, raster.encoded)
    for y, height in rows:
        for x, width in columns:
            digest.update(raster.read(Window(x, y, width_px=width, height_px=height)).data)
    raster.known_id = digest.hexdigest()[:_DIGITS]
    return raster.known_id


def _update_with_file(digest: hashlib._Hash, encoded: str | bytes | None) -> None:
    """Hash an encoded image: the file at its path, or its bytes."""
    if encoded is None:
        return
    try:
        with Path(encoded).open("rb") if isinstance(encoded, str) else BytesIO(encoded) as file:
            size = file.seek(0, os.SEEK_END)
            digest.update(str(size).encode())
            for start in range(0, size, max(_BLOCK_BYTES, -(-size // _BLOCKS))):
                file.seek(start)
                digest.update(file.read(_BLOCK_BYTES))
    except OSError as error:
        raise ImageDecodeError(
            f"cannot read the image {encoded!r} again: {error.strerror}"
        ) from error


def _spans(side_px: int, step: int | None = None) -> list[tuple[int, int]]:
    """Compute the start and length of each window along a side."""
    step = step or max(_WINDOW_PX, -(-side_px // _WINDOWS_PER_SIDE))
    return [(start, min(_WINDOW_PX, side_px - start)) for start in range(0, side_px, step)]
