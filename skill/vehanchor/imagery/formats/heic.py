"""HEIC files of phones, decoded with libheif (extra ``heic``)."""

from __future__ import annotations

import importlib
import io
import struct
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.errors import ImageDecodeError, ImageError, OutOfMemoryError, VehAnchorError
from vehanchor.imagery.file_check import missing_decoder
from vehanchor.imagery.formats.boxes import boxes
from vehanchor.imagery.formats.heif import HEIC, HEIC_PIXEL_BYTES
from vehanchor.imagery.formats.ifd import in_memory
from vehanchor.imagery.formats.image_header import ImageHeader
from vehanchor.imagery.limits import check_header
from vehanchor.imagery.sources.arrays import ArrayRaster

if TYPE_CHECKING:
    from vehanchor.imagery.bands import BandChoice
    from vehanchor.imagery.raster import Raster
    from vehanchor.options import ImageLimits

_DESCRIBES = b"cdsc"
"""Kind of the reference from metadata to the image that they describe."""

_UNKNOWN = b"free"
"""Kind of a reference that libheif ignores."""


def open_heic(data: bytes, source: str, *, bands: BandChoice, limits: ImageLimits) -> Raster:
    """Decode a HEIC; libheif applies its orientation.

    Args:
        data: the file.
        source: name of the image in messages.
        bands: bands to use as red, green and blue.
        limits: limits to apply to the declared size before decoding.

    Raises:
        MissingExtraError: neither pillow-heif nor pi-heif is installed.
        ImageTooLargeError: the image declares too many pixels.
        ImageDecodeError: the image is truncated or damaged.
        ImageFormatError: the image cannot be measured.
    """
    heif = _import_heif(source)
    try:
        image = heif.open_heif(io.BytesIO(_without_metadata(data)))
        # The container's size has been checked; this is the one that libheif allocates.
        width_px, height_px = image.size
        header = ImageHeader(
            "HEIC",
            width_px,
            height_px,
            decoding_bytes=width_px * height_px * HEIC_PIXEL_BYTES,
        )
        check_header(header, limits)
        # libheif owns this memory and frees it with the image. Its rows can be longer than the
        # image is wide.
        pixels = np.asarray(image)[:, :width_px].copy()
    except MemoryError as error:
        raise OutOfMemoryError(
            f"not enough memory for the HEIC ({source}): try again later"
        ) from error
    except VehAnchorError:
        raise
    # A file without a primary image gives an IndexError.
    except (ValueError, RuntimeError, LookupError, OSError, SyntaxError, EOFError) as error:
        raise ImageDecodeError(f"the HEIC ({source}) cannot be decoded: {error}") from error
    return ArrayRaster(pixels, source, bands, alpha=True)


def _import_heif(source: str) -> Any:
    """Import the first of the modules that can decode a HEIC; all have the same names.

    Raises:
        MissingExtraError: none is installed.
    """
    assert HEIC.extra is not None
    for module in HEIC.extra.modules:
        try:
            return importlib.import_module(module)
        except ImportError:
            continue
    raise missing_decoder(HEIC.name, HEIC.extra, source)


def _without_metadata(data: bytes) -> bytes:
    """Detach EXIF and XMP from the images of a HEIC; nothing here reads them.

    pi-heif 1.4 crashes on metadata whose type is not UTF-8.
    """
    changed = bytearray(data)
    # Lengths that make no sense, or are cut off, end the loop; libheif cannot read beyond them,
    # either.
    with suppress(ImageError, struct.error):
        for box in boxes(in_memory(data)):
            if box.kind == b"meta":
                content = changed[box.start : box.end]
                changed[box.start : box.end] = content.replace(_DESCRIBES, _UNKNOWN)
    return bytes(changed)
