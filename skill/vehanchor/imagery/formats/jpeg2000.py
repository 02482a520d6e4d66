"""Header of a JPEG 2000: the sizes of its image and of its tiles."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from vehanchor.errors import ImageDecodeError
from vehanchor.imagery.formats.boxes import boxes
from vehanchor.imagery.formats.image_format import ImageFormat, starts_with
from vehanchor.imagery.formats.image_header import ImageHeader

if TYPE_CHECKING:
    from vehanchor.imagery.formats.ifd import ReadAt

_JP2_FILE = b"\x00\x00\x00\x0cjP  \r\n\x87\n"
_CODESTREAM = b"\xff\x4f\xff\x51"
"""First bytes of a codestream: its first marker, SOC, and SIZ, which must follow."""

_SIGNATURES = (_JP2_FILE, _CODESTREAM)
"""First bytes of a JP2 file, and of a bare codestream."""

_SIZ_OFFSET = 8
"""Bytes of a codestream before the sizes in SIZ: both markers, a length and the capabilities."""

_SIZ_FORMAT = ">8IH"
_MAX_BANDS = 16_384  # in the standard


def read_jpeg2000(read_at: ReadAt) -> ImageHeader:
    """Read the header of a JPEG 2000: the size in its codestream, by which decoders allocate.

    Raises:
        ImageDecodeError: the file is truncated or damaged.
        ImageTooLargeError: the file has more boxes than a real one.
        struct.error: the file ends within its header.
    """
    start = _find_codestream(read_at)
    siz = read_at(start + _SIZ_OFFSET, struct.calcsize(_SIZ_FORMAT))
    (
        right,
        bottom,
        left,
        top,
        tile_width,
        tile_height,
        _tile_left,
        _tile_top,
        bands,
    ) = struct.unpack(_SIZ_FORMAT, siz)
    width = right - left
    height = bottom - top
    is_codestream = read_at(start, len(_CODESTREAM)) == _CODESTREAM
    has_pixels = min(width, height, tile_width, tile_height) >= 1
    if not is_codestream or not has_pixels or not 1 <= bands <= _MAX_BANDS:
        raise ImageDecodeError("the JPEG 2000 declares an invalid size: damaged")
    tile_px = min(tile_width, width) * min(tile_height, height)
    return ImageHeader("JPEG 2000", width, height, tile_px=tile_px, bands=bands)


def _find_codestream(read_at: ReadAt) -> int:
    """Find the offset of the codestream: the start of the file or its first codestream box."""
    if read_at(0, 4) == _CODESTREAM:
        return 0
    for box in boxes(read_at):
        if box.kind == b"jp2c":
            return box.start
    raise ImageDecodeError("the JPEG 2000 holds no image: truncated or damaged")


JPEG_2000 = ImageFormat(
    name="JPEG 2000",
    suffixes=(".jp2",),
    recognises=starts_with(*_SIGNATURES),
    read_header=read_jpeg2000,
    opencv=False,
    gdal_driver="JP2OpenJPEG",
)
