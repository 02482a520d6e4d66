"""Limits on what an image may cost, checked before it is decoded."""

from __future__ import annotations

from dataclasses import dataclass, fields

from vehanchor.options.option import Limits, set_frozen

_MIB = 1 << 20
DECODED_BYTES_PER_PIXEL = 10
"""Memory of 8-bit RGB while it is decoded, with a reserve."""

_COUNT = Limits(least=1, whole=True)


@dataclass(frozen=True)
class ImageLimits:
    """Limits on what an image may cost, checked before it is decoded.

    Attributes:
        max_bytes: encoded size of a file that is read whole.
        max_pixels: declared width x height of an image that is decoded whole. Larger TIFFs and sequential JPEGs are
            read by windows, as JPEG 2000 always is.
        max_windowed_pixels: declared width x height of an image that is read by windows.
        max_decoded_bytes: memory that decoding may take: width x height x bands x depth of an image that is decoded
            whole, or of a strip or tile of one that is read by windows, and what the decoder holds beside it.
        max_unpacked_bytes: disk that a JPEG may take while it is read by windows, three bytes a pixel.

    Raises:
        InvalidParameterError: one of them is no whole number >= 1.
    """

    max_bytes: int = 512 * _MIB
    max_pixels: int = 100_000_000
    max_windowed_pixels: int = 10_000_000_000
    max_decoded_bytes: int = 1 << 30
    max_unpacked_bytes: int = 8 << 30

    def __post_init__(self) -> None:
        for each in fields(self):
            set_frozen(self, each.name, _COUNT.check(each.name, getattr(self, each.name)))
