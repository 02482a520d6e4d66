"""Shape of a pixel by the density in a header: a hint, because programs often write it wrongly."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from vehanchor.imagery.metadata.blocks import metadata_blocks
from vehanchor.imagery.metadata.exif import read_exif
from vehanchor.options.pixel_grid import MAX_ASPECT, usable_aspect

if TYPE_CHECKING:
    from vehanchor.imagery.formats.ifd import ReadAt
    from vehanchor.imagery.formats.image_header import ImageHeader
    from vehanchor.imagery.metadata.exif import ExifTags

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


# EXIF orientations from 5 on swap rows and columns.
_FIRST_SWAPPED = 5


def density_aspect(read_at: ReadAt, header: ImageHeader) -> float:
    """Read the height of a pixel over its width by the densities that a file states.

    JFIF and PNG have their own, TIFF and EXIF have tags. The size of the original image in EXIF is
    a density, too: of a copy that was resized in one direction, or cut. The first pair of unlike
    ones counts.

    Args:
        read_at: reads bytes of the file.
        header: its header, whose orientation turns the pixels upright.

    Returns:
        1 if no pair is unlike, or if one is implausible.
    """
    for across, down in _densities(read_at, header):
        # Many pixels per unit are narrow ones.
        aspect = across / down
        is_plausible = 1 / MAX_ASPECT <= aspect <= MAX_ASPECT
        if aspect == 1.0 or not is_plausible:
            continue
        return 1 / aspect if header.orientation >= _FIRST_SWAPPED else aspect
    return 1.0


def _densities(read_at: ReadAt, header: ImageHeader) -> list[tuple[float, float]]:
    """Read the pixels per unit across and down of the stored pixels, above 0."""
    densities: list[tuple[float, float]] = []
    head = read_at(0, _JFIF_BYTES)
    if head[_JFIF_NAME_AT : _JFIF_NAME_AT + len(_JFIF)] == _JFIF and len(head) == _JFIF_BYTES:
        across, down = struct.unpack_from(">HH", head, _JFIF_DENSITIES_AT)
        densities.append((across, down))
    elif head.startswith(_PNG_SIGNATURE):
        densities.append(_png_densities(read_at))
    exif, _ = metadata_blocks(read_at, header)
    for block in exif:
        tags = read_exif(block)
        resolutions = (tags.get("XResolution"), tags.get("YResolution"))
        if isinstance(resolutions[0], float) and isinstance(resolutions[1], float):
            densities.append((resolutions[0], resolutions[1]))
        densities += _densities_of_copy(tags, header)
    return [(across, down) for across, down in densities if across > 0 and down > 0]


def _densities_of_copy(tags: ExifTags, header: ImageHeader) -> list[tuple[float, float]]:
    """Compute the pixels per pixel of the original image, across and down; none if unknown."""
    width = tags.get("PixelXDimension")
    height = tags.get("PixelYDimension")
    if not isinstance(width, float) or not isinstance(height, float):
        return []
    if width <= 0 or height <= 0:
        return []
    across = header.width_px / width
    down = header.height_px / height
    # A copy that was turned may keep the size from before.
    turned = header.width_px / height * width / header.height_px
    if usable_aspect(across / down) == 1.0 or usable_aspect(turned) == 1.0:
        return []
    return [(across, down)]


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
