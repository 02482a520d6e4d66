"""Header of a JPEG 2000: its sizes, and the memory of its tiles."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.errors import ImageDecodeError, ImageTooLargeError
from vehanchor.imagery.formats.boxes import boxes, check_nested_boxes
from vehanchor.imagery.formats.codestream import read_siz, tile_cost
from vehanchor.imagery.formats.image_format import ImageFormat, starts_with
from vehanchor.imagery.formats.image_header import ImageHeader

if TYPE_CHECKING:
    from vehanchor.imagery.formats.ifd import ReadAt

_JP2_FILE = b"\x00\x00\x00\x0cjP  \r\n\x87\n"
_CODESTREAM = b"\xff\x4f\xff\x51"
"""First bytes of a codestream: its first marker, SOC, and SIZ, which must follow."""

_SIGNATURES = (_JP2_FILE, _CODESTREAM)
"""First bytes of a JP2 file, and of a bare codestream."""

_SUPERBOXES = frozenset((b"jp2h", b"res ", b"asoc", b"uinf", b"jpch", b"jplh"))
"""Boxes that contain boxes."""

_STRUCTURE_BYTES = 256
"""Bytes that count for a precinct or code block of a tile with its tag trees.

OpenJPEG 2.5 takes 105 to 110 bytes and 1 to 2 microseconds for each (tests/bombs.py has the files).
A choice above it, so that the limit on memory bounds the time, too.
"""

_TILE_BYTES = 20_000
_TILE_BAND_BYTES = 3_000
"""Memory that OpenJPEG holds for every tile, and for every band of it, before it decodes one.

A file of 4.5 KB that declared 24,600 tiles of three bands took 717 MiB, or 28 KB a tile; in real
files a tile takes less.
"""

_MAX_SMALL_TILES = 1_000
_TILE_PX_PER_TILE = 4
"""Most tiles of any size, and pixels that each tile has for each of more tiles. Choices.

GDAL reads every tile from the start of the codestream, and OpenJPEG then makes all tiles, about a
microsecond for each: 2,304 tiles of 24 px took 13 s. So a file of 256 px tiles may have 16,384,
1 gigapixel, whose pixels take as long.
"""


def read_jpeg2000(read_at: ReadAt) -> ImageHeader:
    """Read the header of a JPEG 2000: the size in its codestream, by which decoders allocate.

    Raises:
        ImageDecodeError: the file is truncated or damaged.
        ImageTooLargeError: the file has more parts than a real one.
        struct.error: the file ends within its header.
    """
    start = _find_codestream(read_at)
    siz = read_siz(read_at, start)
    tile_px = siz.tile_width_px * siz.tile_height_px
    max_tiles = max(_MAX_SMALL_TILES, tile_px // _TILE_PX_PER_TILE)
    if siz.n_tiles > max_tiles:
        raise ImageTooLargeError(
            f"the JPEG 2000 of {siz.width_px} x {siz.height_px} px has {siz.n_tiles} tiles, more "
            f"than {max_tiles}: save it again with larger tiles"
        )
    cost = tile_cost(read_at, start, siz)
    n_bands = len(siz.subsampling)
    bytes_of_tiles = siz.n_tiles * (_TILE_BYTES + _TILE_BAND_BYTES * n_bands)
    return ImageHeader(
        "JPEG 2000",
        siz.width_px,
        siz.height_px,
        tile_px=tile_px,
        structure_bytes=_STRUCTURE_BYTES * cost.structures + bytes_of_tiles,
        bands=n_bands,
    )


def _find_codestream(read_at: ReadAt) -> int:
    """Find the offset of the codestream: the start of the file or its first codestream box."""
    if read_at(0, 4) == _CODESTREAM:
        return 0
    codestream = None
    for box in boxes(read_at):
        if box.kind == b"jp2c" and codestream is None:
            codestream = box.start
        # GDAL never ends in a box of length 0 within another.
        if box.kind in _SUPERBOXES:
            check_nested_boxes(read_at, box, _SUPERBOXES)
    if codestream is None:
        raise ImageDecodeError("the JPEG 2000 holds no image: truncated or damaged")
    return codestream


JPEG_2000 = ImageFormat(
    name="JPEG 2000",
    suffixes=(".jp2",),
    recognises=starts_with(*_SIGNATURES),
    read_header=read_jpeg2000,
    opencv=False,
    gdal_driver="JP2OpenJPEG",
)
