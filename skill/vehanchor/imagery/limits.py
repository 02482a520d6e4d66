"""Limits on the cost of an image: its bytes, its pixels, and the memory for decoding.

Each limit has one message, whatever the image comes from. ``vehanchor.imagery.file_check`` applies
the limits to files.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.errors import ImageFormatError, ImageTooLargeError
from vehanchor.imagery.formats.header import IMAGE_FORMATS

if TYPE_CHECKING:
    from vehanchor.imagery.formats.image_header import ImageHeader
    from vehanchor.options import ImageLimits

MIN_SIDE_PX = 16
"""Smallest side of a measurable image.

A 5 m car is 17 px long at 0.3 m/px, the coarsest usable GSD.
"""

_BLOCK_COPIES = 2
"""Times that a decoder holds a strip or tile: in one buffer, and in one for each band."""

_MAX_SAMPLES_PER_PIXEL = 4
"""Bands of the largest block: one with as many pixels as the largest image decoded whole."""


def check_bytes(n_bytes: int, max_bytes: int) -> None:
    """Check the bytes of an encoded image, or those that have arrived so far.

    Raises:
        ImageTooLargeError: there are more than ``max_bytes``.
    """
    if n_bytes > max_bytes:
        raise ImageTooLargeError(
            f"the image has more than {max_bytes} bytes (ImageLimits.max_bytes); save it as JPEG, "
            "or as a tiled TIFF and give its path, which is read by windows"
        )


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


def check_whole_size(name: str, width_px: int, *, height_px: int, limits: ImageLimits) -> None:
    """Check the size of an image that is held whole in memory: decoded, an array, of Pillow.

    Args:
        name: format or kind of the image in the message.
        width_px: its width.
        height_px: its height.
        limits: limits to apply.

    Raises:
        ImageTooLargeError: it has too many pixels.
    """
    if width_px * height_px > limits.max_pixels:
        raise ImageTooLargeError(
            f"the {name} has {width_px} x {height_px} px, the limit is {limits.max_pixels} pixels "
            "(--max-megapixels, ImageLimits.max_pixels); convert it to a tiled TIFF, which is read "
            "by windows, or raise the limit"
        )


def check_decoding_memory(name: str, n_bytes: int, *, size: str, limits: ImageLimits) -> None:
    """Check the memory for decoding an image whole.

    Args:
        name: format or kind of the image in the message.
        n_bytes: memory that decoding takes.
        size: width and height in the message.
        limits: limits to apply.

    Raises:
        ImageTooLargeError: it takes too much memory.
    """
    if n_bytes > limits.max_decoded_bytes:
        raise ImageTooLargeError(
            f"decoding the {name} of {size} takes {n_bytes} bytes, the limit is "
            f"{limits.max_decoded_bytes} (ImageLimits.max_decoded_bytes); convert it to 8-bit RGB, "
            "or to a tiled TIFF, which is read by windows"
        )


def check_mask_bytes(n_bytes: int, limits: ImageLimits) -> None:
    """Check the memory of the masks of a call; each fills the box around its object.

    Raises:
        ImageTooLargeError: they take too much memory.
    """
    if n_bytes > limits.max_decoded_bytes:
        raise ImageTooLargeError(
            f"the boxes around the objects have more than {limits.max_decoded_bytes} pixels "
            "together (ImageLimits.max_decoded_bytes): measure fewer at a time"
        )


def check_windowed_size(name: str, width_px: int, *, height_px: int, limits: ImageLimits) -> None:
    """Check the declared size of an image that is read by windows.

    Raises:
        ImageTooLargeError: the image declares too many pixels.
        ImageFormatError: the image is too small to measure.
    """
    if width_px * height_px > limits.max_windowed_pixels:
        raise ImageTooLargeError(
            f"the {name} has {width_px} x {height_px} px, the limit is "
            f"{limits.max_windowed_pixels} pixels (ImageLimits.max_windowed_pixels); split it"
        )
    check_side(width_px, height_px)


def block_bytes(block_px: int, *, samples: int, sample_bytes: int) -> int:
    """Compute the memory for decoding a strip or tile; see ``check_block``."""
    return _BLOCK_COPIES * block_px * samples * sample_bytes


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
    decoding_bytes = block_bytes(block_px, samples=samples, sample_bytes=sample_bytes)
    has_too_many_samples = n_samples > _MAX_SAMPLES_PER_PIXEL * limits.max_pixels
    if has_too_many_samples or decoding_bytes > limits.max_decoded_bytes:
        raise ImageTooLargeError(
            f"the {name} is stored in blocks of {block_px} pixels with {samples} bands of "
            f"{sample_bytes} bytes, too large to read by windows under the limits of "
            f"{limits.max_pixels} pixels and {limits.max_decoded_bytes} bytes; store it tiled"
        )


def check_header(header: ImageHeader, limits: ImageLimits) -> None:
    """Check the declared size of an image; images that can be read by windows may be larger.

    Raises:
        ImageTooLargeError: it has too many pixels, or decoding it takes too much memory.
        ImageFormatError: it is too small to measure.
    """
    name = header.format
    width = header.width_px
    height = header.height_px
    if IMAGE_FORMATS[name].gdal_driver is None:
        check_whole_size(name, width, height_px=height, limits=limits)
        size = f"{width} x {height} px"
        check_decoding_memory(name, header.decoding_bytes, size=size, limits=limits)
    check_windowed_size(name, width, height_px=height, limits=limits)
