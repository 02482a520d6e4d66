"""Shape of a pixel by the density in a header: a hint, because programs often write it wrongly."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from vehanchor.options.pixel_grid import MAX_ASPECT

if TYPE_CHECKING:
    from vehanchor.imagery.formats.ifd import ReadAt

# Start of image, application segment 0, its length, JFIF; then version, unit, both densities.
_JFIF_BYTES = 18
_JFIF = b"JFIF\0"
_JFIF_NAME_AT = 6
_JFIF_DENSITIES_AT = 14

# PNG: the signature, then chunks of length, type, data and checksum; pHYs precedes the pixels.
_PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_CHUNK_HEAD_BYTES = 8
_CHUNK_REST_BYTES = 12
_MAX_CHUNKS = 32


def density_aspect(read_at: ReadAt) -> float:
    """Read the height of a pixel over its width by JFIF or PNG; 1 if neither states it.

    Args:
        read_at: reads bytes of the file.
    """
    head = read_at(0, _JFIF_BYTES)
    across = 0
    down = 0
    if head[_JFIF_NAME_AT : _JFIF_NAME_AT + len(_JFIF)] == _JFIF and len(head) == _JFIF_BYTES:
        across, down = struct.unpack_from(">HH", head, _JFIF_DENSITIES_AT)
    elif head.startswith(_PNG_SIGNATURE):
        across, down = _png_densities(read_at)
    if not across or not down:
        return 1.0
    # Many pixels per unit are narrow ones.
    aspect = across / down
    is_plausible = 1 / MAX_ASPECT <= aspect <= MAX_ASPECT
    return aspect if is_plausible else 1.0


def _png_densities(read_at: ReadAt) -> tuple[int, int]:
    """Read the pixels per unit across and down of a PNG; zeros without them."""
    start = len(_PNG_SIGNATURE)
    for _ in range(_MAX_CHUNKS):
        head = read_at(start, _CHUNK_HEAD_BYTES)
        if len(head) < _CHUNK_HEAD_BYTES:
            break
        length, name = struct.unpack(">I4s", head)
        if name == b"IDAT":
            break
        if name == b"pHYs":
            data = read_at(start + _CHUNK_HEAD_BYTES, 8)
            if len(data) == 8:
                across, down = struct.unpack(">II", data)
                return across, down
        start += length + _CHUNK_REST_BYTES
    return 0, 0
