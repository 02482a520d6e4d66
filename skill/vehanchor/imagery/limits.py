"""Checks before decoding: size of the file, declared size of the image, memory for decoding."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.errors import ImageFormatError, ImageTooLargeError
from vehanchor.imagery.formats.header import read_header
from vehanchor.imagery.formats.ifd import ReadAt
from vehanchor.imagery.formats.image_header import ImageHeader

if TYPE_CHECKING:
    from vehanchor.options import ImageLimits

MIN_SIDE_PX = 16
"""Smallest side of a measurable image.

A 5 m car is 17 px long at 0.3 m/px, the coarsest usable GSD.
"""

WINDOWED_FORMATS = ("TIFF", "JPEG 2000")
"""Formats that can be read by windows."""

_BLOCK_COPIES = 2
"""Times that a decoder holds a strip or tile: in one buffer, and in one for each band."""

_MAX_SAMPLES_PER_PIXEL = 4
"""Bands of the largest block: one with as many pixels as the largest image decoded whole."""


def check_bytes(n_bytes: int, limits: ImageLimits) -> None:
    """Check the size of an encoded image.

    Raises:
        ImageTooLargeError: it exceeds ``limits.max_bytes``.
    """
    if n_bytes > limits.max_bytes:
        raise ImageTooLargeError(f"the image has {n_bytes} bytes, the limit is {limits.max_bytes}")


def check_side(width_px: int, height_px: int, hint: str = "") -> None:
    """Check that an image is large enough to measure.

    Raises:
        ImageFormatError: a side is too short; the message ends with ``hint``.
    """
    if min(width_px, height_px) < MIN_SIDE_PX:
        raise ImageFormatError(
            f"the image is {width_px} x {height_px} px; at least {MIN_SIDE_PX} px a side are "
            f"needed{hint}"
        )


def check_windowed_size(name: str, width_px: int, *, height_px: int, limits: ImageLimits) -> None:
    """Check the declared size of an image that is read by windows.

    Raises:
        ImageTooLargeError: the image declares too many pixels.
        ImageFormatError: the image is too small to measure.
    """
    if width_px * height_px > limits.max_windowed_pixels:
        raise ImageTooLargeError(
            f"the {name} declares {width_px} x {height_px} px, the limit is "
            f"{limits.max_windowed_pixels} pixels"
        )
    check_side(width_px, height_px)


def check_block(
    name: str, block_px: int, *, samples: int, sample_bytes: int, limits: ImageLimits
) -> None:
    """Check the size of a strip or tile, because decoders decode it whole.

    Args:
        name: format or name of the image in the message.
        block_px: pixels of the block.
        samples: bands stored together in the block.
        sample_bytes: decoded bytes of one sample.
        limits: limits to apply.

    Raises:
        ImageTooLargeError: decoding the block would exceed the limits.
    """
    n_samples = block_px * samples
    decoding_bytes = _BLOCK_COPIES * n_samples * sample_bytes
    has_too_many_samples = n_samples > _MAX_SAMPLES_PER_PIXEL * limits.max_pixels
    if has_too_many_samples or decoding_bytes > limits.max_decoded_bytes:
        raise ImageTooLargeError(
            f"the {name} is stored in blocks of {block_px} pixels with {samples} bands of "
            f"{sample_bytes} bytes, too large to read by windows under the limits of "
            f"{limits.max_pixels} pixels and {limits.max_decoded_bytes} bytes; store it tiled"
        )


def read_checked_header(read_at: ReadAt, limits: ImageLimits) -> ImageHeader:
    """Read an image's header and check its declared size.

    Raises:
        ImageDecodeError: the format is unknown, or the header is damaged.
        ImageTooLargeError: the image has too many pixels, or decoding it takes too much memory.
        ImageFormatError: the image is too small to measure.
    """
    header = read_header(read_at)
    check_header(header, limits)
    return header


def check_header(header: ImageHeader, limits: ImageLimits) -> None:
    """Check an image's header; images that can be read by windows may be larger.

    Raises:
        ImageTooLargeError: see ``read_checked_header``.
        ImageFormatError: the image is too small to measure.
    """
    if header.format not in WINDOWED_FORMATS:
        _check_whole_decoding(header, limits)
    check_windowed_size(header.format, header.width_px, height_px=header.height_px, limits=limits)


def _check_whole_decoding(header: ImageHeader, limits: ImageLimits) -> None:
    """Check the size and the memory of an image that can only be decoded whole.

    Raises:
        ImageTooLargeError: it has too many pixels, or decoding it takes too much memory.
    """
    size = f"{header.width_px} x {header.height_px} px"
    if header.width_px * header.height_px > limits.max_pixels:
        raise ImageTooLargeError(
            f"the {header.format} declares {size}, the limit is {limits.max_pixels} pixels "
            "(--max-megapixels, ImageLimits.max_pixels); convert it to a tiled TIFF, which is read "
            "by windows, or raise the limit"
        )
    if header.decoding_bytes > limits.max_decoded_bytes:
        raise ImageTooLargeError(
            f"decoding the {header.format} of {size} takes {header.decoding_bytes} bytes, "
            f"the limit is {limits.max_decoded_bytes}; convert it to 8-bit RGB, or to a tiled "
            "TIFF, which is read by windows"
        )
