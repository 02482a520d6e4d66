"""Limits on the cost of an image, checked before decoding."""

from __future__ import annotations

from typing import Annotated

from vehanchor.options.option import Limits, group

_MIB = 1 << 20
DECODED_BYTES_PER_PIXEL = 10
"""Memory for decoding 8-bit RGB, with a reserve."""

_Count = Annotated[int, Limits(least=1, whole=True)]


@group(frozen=True)
class ImageLimits:
    """Limits on the cost of an image, checked before decoding.

    Attributes:
        max_bytes: encoded size of a file that is read whole.
        max_pixels: declared width x height of an image that is decoded whole. Larger TIFFs and sequential JPEGs, and
            all JPEG 2000, are read by windows.
        max_windowed_pixels: declared width x height of an image that is read by windows.
        max_decoded_bytes: memory for decoding: width x height x bands x depth of an image decoded whole, or of a strip
            or tile of one read by windows, and the decoder's own memory.
        max_unpacked_bytes: disk space for a JPEG that is read by windows, three bytes per pixel.

    Raises:
        InvalidParameterError: a limit is not a whole number >= 1.
    """

    max_bytes: _Count = 512 * _MIB
    max_pixels: _Count = 100_000_000
    max_windowed_pixels: _Count = 10_000_000_000
    max_decoded_bytes: _Count = 1 << 30
    max_unpacked_bytes: _Count = 8 << 30
