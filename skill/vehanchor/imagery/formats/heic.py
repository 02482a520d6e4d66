"""HEIC files of phones, decoded with libheif (extra ``heic``)."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.errors import ImageDecodeError, MissingExtraError, OutOfMemoryError, VehAnchorError
from vehanchor.imagery.formats.image_header import ImageHeader
from vehanchor.imagery.limits import check_header
from vehanchor.imagery.sources.arrays import ArrayRaster

if TYPE_CHECKING:
    from vehanchor.imagery.bands import BandChoice
    from vehanchor.imagery.raster import Raster
    from vehanchor.options import ImageLimits

_BYTES_PER_PIXEL = 12
"""Memory for decoding: two 16-bit planes of HEVC's colours, and RGB with alpha twice."""


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
        image = heif.open_heif(io.BytesIO(data))
        width_px, height_px = image.size
        header = ImageHeader(
            "HEIC",
            width_px,
            height_px,
            decoding_bytes=width_px * height_px * _BYTES_PER_PIXEL,
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
    except (ValueError, RuntimeError, EOFError, OSError, SyntaxError) as error:
        raise ImageDecodeError(f"the HEIC ({source}) cannot be decoded: {error}") from error
    return ArrayRaster(pixels, source, bands, alpha=True)


def _import_heif(source: str) -> Any:
    """Import pillow-heif, or pi-heif, which has the same names but no encoder.

    Raises:
        MissingExtraError: neither is installed.
    """
    try:
        import pillow_heif as heif
    except ImportError:
        try:
            import pi_heif as heif
        except ImportError:
            raise MissingExtraError(
                f"reading a HEIC ({source}) needs pi-heif: pip install 'vehanchor[heic]', or "
                "convert it to JPEG"
            ) from None
    return heif
