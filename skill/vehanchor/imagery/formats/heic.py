"""HEIC, as telephones write it, through Pillow and libheif (extra ``heic``)."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.errors import ImageDecodeError, MissingExtraError, OutOfMemoryError, VehAnchorError
from vehanchor.imagery.formats.header import ImageHeader
from vehanchor.imagery.limits import check_header
from vehanchor.imagery.sources.arrays import ArrayRaster

if TYPE_CHECKING:
    from vehanchor.imagery.bands import BandChoice
    from vehanchor.imagery.raster import Raster
    from vehanchor.options import ImageLimits

_BRANDS = frozenset({b"heic", b"heix"})  # still pictures by HEVC; hevc and hevx are sequences
_ANY_STILL = frozenset({b"mif1"})
_LISTED = 32  # bytes of the brands that are looked at
_BYTES_A_PIXEL = 12  # two planes of HEVC's own colours with 16 bits, and RGB twice, with alpha


def is_heic(start: bytes) -> bool:
    """Whether these first bytes, 32 are enough, open a still HEIC."""
    if start[4:8] != b"ftyp":
        return False
    compatible = {start[at : at + 4] for at in range(16, min(int.from_bytes(start[:4]), _LISTED), 4)}
    return start[8:12] in _BRANDS or (start[8:12] in _ANY_STILL and not _BRANDS.isdisjoint(compatible))


def open_heic(data: bytes, source: str, bands: BandChoice, limits: ImageLimits) -> Raster:
    """Decode a HEIC; libheif turns it as its container says.

    Args:
        data: the file.
        source: what to call it.
        bands: which bands are red, green and blue.
        limits: held against the size that it declares, before it is decoded.

    Raises:
        MissingExtraError: neither pillow-heif nor pi-heif is installed.
        ImageTooLargeError: it declares too many pixels.
        ImageDecodeError: it is truncated or damaged.
        ImageFormatError: it cannot be measured.
    """
    heif = _import_heif(source)
    try:
        image = heif.open_heif(io.BytesIO(data))
        width_px, height_px = image.size
        decoding_bytes = width_px * height_px * _BYTES_A_PIXEL
        check_header(ImageHeader("HEIC", width_px, height_px, decoding_bytes=decoding_bytes), limits)
        pixels = np.asarray(image)
    except MemoryError as error:
        raise OutOfMemoryError(f"no memory for the HEIC ({source}): try again later") from error
    except (ValueError, RuntimeError, EOFError, OSError, SyntaxError) as error:
        if isinstance(error, VehAnchorError):
            raise
        raise ImageDecodeError(f"the HEIC ({source}) cannot be decoded: {error}") from error
    return ArrayRaster(pixels, source, bands)


def _import_heif(source: str) -> Any:
    try:
        import pillow_heif as heif
    except ImportError:
        try:
            import pi_heif as heif
        except ImportError:
            raise MissingExtraError(
                f"it is HEIC ({source}), which pi-heif reads: pip install 'vehanchor[heic]', or convert it to JPEG"
            ) from None
    return heif
