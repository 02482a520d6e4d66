"""Header of a BMP."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

from vehanchor.imagery.formats.image_format import ImageFormat, starts_with
from vehanchor.imagery.formats.image_header import COPIES, ImageHeader

if TYPE_CHECKING:
    from vehanchor.imagery.formats.ifd import ReadAt


def read_bmp(read_at: ReadAt) -> ImageHeader:
    """Read the header of a BMP.

    Raises:
        struct.error: the file ends within its header.
    """
    (header_bytes,) = struct.unpack("<I", read_at(14, 4))
    is_os2 = header_bytes == 12
    if is_os2:
        width, height = struct.unpack("<HH", read_at(18, 4))
    else:
        width, height = struct.unpack("<ii", read_at(18, 8))
    # A negative height means rows from top to bottom.
    width = abs(width)
    height = abs(height)
    return ImageHeader("BMP", width, height, decoding_bytes=COPIES * 4 * width * height)


BMP = ImageFormat(
    name="BMP", suffixes=(".bmp",), recognises=starts_with(b"BM"), read_header=read_bmp
)
