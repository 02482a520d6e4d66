"""What is refused before anything is decoded: by its bytes, by the size that it declares."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vehanchor.errors import ImageFormatError, ImageTooLargeError
from vehanchor.imagery.formats.header import ImageHeader, read_header
from vehanchor.imagery.formats.ifd import ReadAt

if TYPE_CHECKING:
    from vehanchor.options import ImageLimits

MIN_SIDE_PX = 16
"""Smallest side of an image that can be measured: a car of 5 m is 17 px long at 0.3 m/px, the coarsest scale of use."""

UNPACKED_BYTES = 3
"""Of a pixel of a JPEG that is read by windows, on the disk."""

_SCANS_OF_LARGEST = 25  # an image of the largest size may be stored in so many scans, a smaller one in more
_BLOCK_COPIES = 2  # a strip or tile is decoded into one buffer, and from there into one for each band
_SAMPLES_PER_PIXEL = 4  # of a block as large as an image may be


def check_bytes(n_bytes: int, limits: ImageLimits) -> None:
    """Make sure that an encoded image may be held in memory.

    Raises:
        ImageTooLargeError: it may not.
    """
    if n_bytes > limits.max_bytes:
        raise ImageTooLargeError(f"the image has {n_bytes} bytes, the limit is {limits.max_bytes}")


def check_side(width_px: int, height_px: int, hint: str = "") -> None:
    """Make sure that an image is large enough to be measured.

    Raises:
        ImageFormatError: it is not; ``hint`` is said, too.
    """
    if min(width_px, height_px) < MIN_SIDE_PX:
        raise ImageFormatError(
            f"the image is {width_px} x {height_px} px; at least {MIN_SIDE_PX} px a side are needed{hint}"
        )


def check_windowed_size(name: str, width_px: int, height_px: int, limits: ImageLimits) -> None:
    """Make sure that an image may be read by windows, and is large enough to be measured.

    Raises:
        ImageTooLargeError: it declares too many pixels.
        ImageFormatError: too few.
    """
    if width_px * height_px > limits.max_windowed_pixels:
        raise ImageTooLargeError(
            f"the {name} declares {width_px} x {height_px} px, the limit is {limits.max_windowed_pixels} pixels"
        )
    check_side(width_px, height_px)


def check_block(name: str, block_px: int, samples: int, sample_bytes: int, limits: ImageLimits) -> None:
    """Make sure that a strip or tile, which is decoded as a whole, is not what the limits were to prevent.

    Args:
        name: what to call the image.
        block_px: its pixels.
        samples: bands that are stored together in it.
        sample_bytes: bytes of one of them, decoded.
        limits: what to refuse.

    Raises:
        ImageTooLargeError: it is.
    """
    decoded = _BLOCK_COPIES * block_px * samples * sample_bytes
    if block_px * samples > _SAMPLES_PER_PIXEL * limits.max_pixels or decoded > limits.max_decoded_bytes:
        raise ImageTooLargeError(
            f"the {name} is stored in blocks of {block_px} pixels with {samples} bands of {sample_bytes} bytes, too "
            f"large to read by windows under the limits of {limits.max_pixels} pixels and {limits.max_decoded_bytes} "
            "bytes; store it tiled"
        )


def read_checked_header(read_at: ReadAt, limits: ImageLimits) -> ImageHeader:
    """Read what an image says of itself, and hold its declared size against the limits.

    Raises:
        ImageDecodeError: not an image of a known format, or its header is broken.
        ImageTooLargeError: it declares too many pixels to be decoded whole, a TIFF to be read at all; or decoding it
            takes too much memory, or goes over it too often.
        ImageFormatError: too few to be measured.
    """
    header = read_header(read_at)
    check_header(header, limits)
    return header


def check_header(header: ImageHeader, limits: ImageLimits) -> None:
    """Hold what an image declares against the limits; one that can be read by windows may be larger than others.

    Raises:
        ImageTooLargeError: see ``read_checked_header``.
        ImageFormatError: too few pixels to be measured.
    """
    windowed = header.windowed and (
        header.format != "JPEG" or UNPACKED_BYTES * header.width_px * header.height_px <= limits.max_unpacked_bytes
    )
    if not windowed and header.width_px * header.height_px > limits.max_pixels:
        raise ImageTooLargeError(
            f"the {header.format} declares {header.width_px} x {header.height_px} px, the limit is "
            f"{limits.max_pixels} pixels (--max-megapixels, ImageLimits.max_pixels); convert it to a tiled TIFF, "
            "which is read by windows, or raise the limit"
        )
    if not windowed and header.decoding_bytes > limits.max_decoded_bytes:
        raise ImageTooLargeError(
            f"decoding the {header.format} of {header.width_px} x {header.height_px} px takes {header.decoding_bytes} "
            f"bytes, the limit is {limits.max_decoded_bytes}; convert it to 8-bit RGB, or to a tiled TIFF, which is "
            "read by windows"
        )
    if (
        header.n_scans > 1
        and header.n_scans * header.width_px * header.height_px > _SCANS_OF_LARGEST * limits.max_pixels
    ):
        raise ImageTooLargeError(
            f"the {header.format} of {header.width_px} x {header.height_px} px has {header.n_scans} scans, each "
            "decoded over the whole image; save it again"
        )
    check_windowed_size(header.format, header.width_px, header.height_px, limits)
