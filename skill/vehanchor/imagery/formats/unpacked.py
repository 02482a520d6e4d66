"""Large JPEGs: decoded once, strip by strip, into a file without a name, and read from there by windows.

A JPEG has no places to begin at: a tile further up would have all rows above it decoded again. The file lies where
``tempfile`` puts it (``TMPDIR``), takes three bytes a pixel there, and is gone with the raster.
"""

from __future__ import annotations

import shutil
import tempfile
from contextlib import ExitStack
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.errors import ImageDecodeError, ImageTooLargeError
from vehanchor.imagery.sources.arrays import ArrayRaster
from vehanchor.imagery.sources.rasterio_file import dataset_of, gdal

if TYPE_CHECKING:
    from vehanchor.imagery.bands import BandChoice
    from vehanchor.imagery.formats.header import ImageHeader
    from vehanchor.imagery.raster import Raster
    from vehanchor.options import ImageLimits

_STRIP_ROWS = 256
_SPARE_BYTES = 1 << 28  # left to others on the disk


def open_large_jpeg(
    file: str | bytes, source: str, header: ImageHeader, bands: BandChoice, limits: ImageLimits
) -> Raster:
    """Decode a sequential JPEG of any size.

    Args:
        file: its absolute path or its bytes.
        source: what to call it.
        header: what it says of itself.
        bands: which bands are red, green and blue.
        limits: what to refuse.

    Raises:
        MissingExtraError: rasterio is not installed.
        ImageTooLargeError: the disk has too little room.
        ImageDecodeError: it is truncated or damaged.
        ImageFormatError: it cannot be measured.
    """
    if not header.complete:
        raise ImageDecodeError(f"the JPEG ({source}) is truncated: its end mark is missing")
    # libjpeg warns of damage and goes on: for GDAL, too, it shall be an error.
    with ExitStack() as stack, gdal(source, GDAL_ERROR_ON_LIBJPEG_WARNING="YES"):
        dataset = dataset_of(file, source, header, limits, stack)
        height, width, count = dataset.height, dataset.width, dataset.count
        _check_room(width * height * count)
        with tempfile.TemporaryFile(prefix="vehanchor-") as unpacked:
            pixels = np.memmap(unpacked, np.uint8, "w+", shape=(height, width, count))
        for top in range(0, height, _STRIP_ROWS):
            below = min(top + _STRIP_ROWS, height)
            strip = dataset.read(window=((top, below), (0, width)))
            pixels[top:below] = strip.transpose(1, 2, 0)
    return ArrayRaster(pixels, source, bands, orientation=header.orientation)


def _check_room(n_bytes: int) -> None:
    free = shutil.disk_usage(tempfile.gettempdir()).free
    if n_bytes > free - _SPARE_BYTES:
        raise ImageTooLargeError(
            f"unpacking the JPEG takes {n_bytes} bytes of disk, {tempfile.gettempdir()} has {free}: make room, name "
            "another folder by TMPDIR, or convert it to a tiled TIFF, which is read by windows"
        )
