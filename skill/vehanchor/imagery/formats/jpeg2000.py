"""Header of a JPEG 2000: the sizes of its image and of its tiles."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from vehanchor.errors import ImageDecodeError
from vehanchor.imagery.formats.boxes import boxes
from vehanchor.imagery.formats.image_header import ImageHeader

if TYPE_CHECKING:
    from vehanchor.imagery.formats.ifd import ReadAt

SIGNATURES = (b"\x00\x00\x00\x0cjP  \r\n\x87\n", _CODESTREAM := b"\xff\x4f\xff\x51")
"""First bytes of a JP2 file, and of a bare codestream: its first marker, SOC, and SIZ, which must follow."""

_MAX_BANDS = 16_384  # in the standard


def read_jpeg2000(read_at: ReadAt) -> ImageHeader:
    """Read the header of a JPEG 2000, with the size that the codestream declares: decoders allocate by it.

    Raises:
        ImageDecodeError: the file is truncated or damaged.
        ImageTooLargeError: the file has more boxes than a real one.
    """
    at = _codestream_at(read_at)
    right, bottom, left, top, tile_width, tile_height, _, _, bands = struct.unpack(
        ">8IH", read_at(at + 8, 34)
    )
    width = right - left
    height = bottom - top
    if (
        read_at(at, 4) != _CODESTREAM
        or min(width, height, tile_width, tile_height) < 1
        or not 1 <= bands <= _MAX_BANDS
    ):
        raise ImageDecodeError("the JPEG 2000 declares an invalid size: damaged")
    tile_px = min(tile_width, width) * min(tile_height, height)
    return ImageHeader("JPEG 2000", width, height, tile_px=tile_px, bands=bands)


def _codestream_at(read_at: ReadAt) -> int:
    """Find the offset of the codestream: the start of the file or its first codestream box."""
    if read_at(0, 4) == _CODESTREAM:
        return 0
    found = next((box.start for box in boxes(read_at) if box.kind == b"jp2c"), None)
    if found is None:
        raise ImageDecodeError("the JPEG 2000 holds no image: truncated or damaged")
    return found
