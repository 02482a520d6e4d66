"""Identity of an image: a checksum, which is equal for a path and for the bytes of its file.

The checksum covers all pixels of an image that is decoded whole, so it equals that of the array.
The same holds for an image that is read by windows if no side is longer than 4096 px. For a larger
one, the checksum covers 64 windows and the encoded file.
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
_WINDOW_PX = 512
_MAX_COVERED_PX = _WINDOWS_PER_SIDE * _WINDOW_PX
"""Longest side that the windows of an image cover without gaps: 4096 px."""

_DIGITS = 16
_MAX_BLOCKS = 512
_BLOCK_BYTES = 1 << 20


def image_id(raster: Raster) -> str:
    """Hash size and content to 16 hexadecimal digits.

    Of a file of more than 512 MiB that is read by windows, 512 evenly spaced blocks of 1 MiB count.
    Of the caller's rasterio dataset, only the windows count.
    """
    # The identity is that of the file, whatever pixels it is shown in.
    raster = raster.in_file
    if raster.cached_id:
        return raster.cached_id
    digest = hashlib.sha256(f"{raster.width_px} x {raster.height_px}".encode())
    if raster.in_memory:
        columns = _all_spans(raster.width_px)
        rows = _all_spans(raster.height_px)
    else:
        columns = _spaced_spans(raster.width_px)
        rows = _spaced_spans(raster.height_px)
        # The windows leave gaps, in which two images can differ.
        if max(raster.width_px, raster.height_px) > _MAX_COVERED_PX:
            _update_with_file(digest, raster.encoded)
    for y, height in rows:
        for x, width in columns:
            window = Window(x, y, width_px=width, height_px=height)
            digest.update(raster.read(window).data)
    raster.cached_id = digest.hexdigest()[:_DIGITS]
    return raster.cached_id


def _update_with_file(digest: hashlib._Hash, encoded: str | bytes | None) -> None:
    """Hash an encoded image: the file at its path, or its bytes.

    Raises:
        ImageDecodeError: the file cannot be read any more.
    """
    if encoded is None:
        return
    try:
        with Path(encoded).open("rb") if isinstance(encoded, str) else BytesIO(encoded) as file:
            n_bytes = file.seek(0, os.SEEK_END)
            digest.update(str(n_bytes).encode())
            # Blocks of a file of up to 512 MiB follow each other without gaps.
            step = max(_BLOCK_BYTES, _ceil_divide(n_bytes, _MAX_BLOCKS))
            for start in range(0, n_bytes, step):
                file.seek(start)
                digest.update(file.read(_BLOCK_BYTES))
    except OSError as error:
        raise ImageDecodeError(
            f"cannot read the image {encoded!r} again: {error.strerror}"
        ) from error


def _all_spans(side_px: int) -> list[tuple[int, int]]:
    """Compute the start and length of windows that cover a whole side."""
    return _spans(side_px, step=_WINDOW_PX)


def _spaced_spans(side_px: int) -> list[tuple[int, int]]:
    """Compute the start and length of at most eight windows along a side, evenly spaced."""
    step = max(_WINDOW_PX, _ceil_divide(side_px, _WINDOWS_PER_SIDE))
    return _spans(side_px, step)


def _spans(side_px: int, step: int) -> list[tuple[int, int]]:
    spans = []
    for start in range(0, side_px, step):
        length = min(_WINDOW_PX, side_px - start)
        spans.append((start, length))
    return spans


def _ceil_divide(dividend: int, divisor: int) -> int:
    return -(-dividend // divisor)
