"""Large JPEGs, decoded once in strips into an unnamed temporary file and read from there by windows.

A JPEG has no random access: each tile would need all rows above it decoded again. The file lies in ``TMPDIR``, takes
three bytes per pixel, and disappears with the raster.
"""

from __future__ import annotations

import shutil
import tempfile
from contextlib import ExitStack
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.errors import ImageDecodeError, ImageTooLargeError
from vehanchor.imagery.sources.arrays import ArrayRaster
from vehanchor.imagery.sources.rasterio_file import gdal_environment, import_rasterio, open_rasterio

if TYPE_CHECKING:
    from vehanchor.imagery.bands import BandChoice
    from vehanchor.imagery.formats.image_header import ImageHeader
    from vehanchor.imagery.raster import Raster
    from vehanchor.options import ImageLimits

_STRIP_ROWS = 256
_SPARE_BYTES = 1 << 28  # left free on the disk


def open_large_jpeg(
    file: str | bytes, source: str, header: ImageHeader, bands: BandChoice, limits: ImageLimits
) -> Raster:
    """Decode a sequential JPEG of any size.

    Args:
        file: its absolute path or its bytes.
        source: name of the image in messages.
        header: its header.
        bands: bands to use as red, green and blue.
        limits: limits to apply.

    Raises:
        MissingExtraError: rasterio is not installed.
        ImageTooLargeError: the disk has too little space.
        ImageDecodeError: the image is truncated or damaged.
        ImageFormatError: the image cannot be measured.
    """
    if not header.complete:
        raise ImageDecodeError(f"the JPEG ({source}) is truncated: its end mark is missing")
    import_rasterio(source, header)  # before its own environment
    # libjpeg only warns of damage; GDAL must treat it as an error.
    with ExitStack() as stack, gdal_environment(source, GDAL_ERROR_ON_LIBJPEG_WARNING="YES"):
        dataset = open_rasterio(file, source, header, limits, stack)
        height, width, count = dataset.height, dataset.width, dataset.count
        n_bytes, free = width * height * count, shutil.disk_usage(tempfile.gettempdir()).free
        if n_bytes > free - _SPARE_BYTES:
            raise ImageTooLargeError(
                f"unpacking the JPEG takes {n_bytes} bytes of disk, {tempfile.gettempdir()} has {free}: free some "
                "space, set TMPDIR to another folder, or convert the image to a tiled TIFF, which is read by windows"
            )
        with tempfile.TemporaryFile(prefix="vehanchor-") as unpacked:
            pixels = np.memmap(unpacked, np.uint8, "w+", shape=(height, width, count))
        for top in range(0, height, _STRIP_ROWS):
            below = min(top + _STRIP_ROWS, height)
            strip = dataset.read(window=((top, below), (0, width)))
            pixels[top:below] = strip.transpose(1, 2, 0)
    return ArrayRaster(pixels, source, bands, orientation=header.orientation)
