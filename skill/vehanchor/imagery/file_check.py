"""The check of an image file before anything of it is decoded, the same at every door.

The doors are a path, bytes, a file object, a photograph dropped on the page of ``vehanchor view``,
and the path, base64 and URL of a call to the server. Each of them passes a file to ``check_file``,
so that a file has the same answer at all of them. Three differences are intended:

* **Windows**: only a file on disk may have more bytes than ``ImageLimits.max_bytes``, and only if
  it is read by windows. All other doors hold the whole file in memory. A door that receives a file
  in parts calls ``check_bytes`` for each of them.
* **Lists go by suffix**: a folder lists the files with a suffix of ``IMAGE_FORMATS``, because
  opening every file of a folder would be slow. A file that is opened goes by its content alone.
* **The decoder has the last word**: the pixels can still be damaged, and a TIFF's single strip or a
  HEVC frame can still be too large. Their decoders check them again.

The check imports no decoder, so the process of a server that listens can call it.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.errors import ImageDecodeError, ImageFormatError, MissingExtraError, how_to_install
from vehanchor.imagery.formats.header import IMAGE_FORMATS, read_header
from vehanchor.imagery.formats.tiff import decoded_by_opencv
from vehanchor.imagery.limits import (
    block_bytes,
    check_block,
    check_bytes,
    check_decoding_memory,
    check_header,
)

if TYPE_CHECKING:
    from vehanchor.imagery.formats.ifd import ReadAt
    from vehanchor.imagery.formats.image_format import DecoderExtra
    from vehanchor.imagery.formats.image_header import ImageHeader, TiffLayout
    from vehanchor.options import ImageLimits

_SUPPORTED_PHOTOMETRIC = (1, 2, 3, 6)
"""TIFF's codes of colours that are read by windows: grey from black, RGB, palette and YCbCr."""

_OPENJPEG_SAMPLE_BYTES = 4


class CheckedFile(NamedTuple):
    """Image file that may be decoded.

    Attributes:
        header: its header.
        by_windows: whether it is read by windows instead of being decoded whole.
    """

    header: ImageHeader
    by_windows: bool


def check_file(
    read_at: ReadAt, n_bytes: int, source: str, *, limits: ImageLimits, on_disk: bool
) -> CheckedFile:
    """Check an image file before anything of it is decoded.

    Args:
        read_at: reads the file.
        n_bytes: its size.
        source: name of the image in messages.
        limits: limits to apply.
        on_disk: whether it stays on disk while it is read by windows.

    Raises:
        ImageDecodeError: the file is empty or truncated, its format is unknown, or its header is
            damaged.
        ImageTooLargeError: it has too many bytes or pixels, decoding it takes too much memory, or
            one of its blocks is too large.
        ImageFormatError: it is too small to measure, a raw file, or has unsupported colours.
        MissingExtraError: it needs rasterio or the decoder of an extra, which is not installed.
    """
    if n_bytes == 0:
        raise ImageDecodeError(f"the image ({source}) is empty: 0 bytes")
    if not on_disk:
        check_bytes(n_bytes, limits.max_bytes)
    header = read_header(read_at)
    check_header(header, limits)
    by_windows = _needs_windows(header, n_bytes, limits)
    if not header.complete:
        raise ImageDecodeError(f"the {header.format} ({source}) is truncated: its end is missing")
    if by_windows:
        _check_blocks(header, source, limits)
    else:
        check_bytes(n_bytes, limits.max_bytes)
    _check_extra(header, source, by_windows=by_windows)
    return CheckedFile(header, by_windows)


def _needs_windows(header: ImageHeader, n_bytes: int, limits: ImageLimits) -> bool:
    """Test whether an image must be read by windows instead of being decoded whole."""
    if header.tiff is None:
        image_format = IMAGE_FORMATS[header.format]
        return image_format.gdal_driver is not None and not image_format.opencv
    has_too_many_bytes = n_bytes > limits.max_bytes
    has_too_many_pixels = header.width_px * header.height_px > limits.max_pixels
    takes_too_much_memory = header.decoding_bytes > limits.max_decoded_bytes
    if has_too_many_bytes or has_too_many_pixels or takes_too_much_memory:
        return True
    return header.tiff.georeferenced or not decoded_by_opencv(header.tiff)


def _check_blocks(header: ImageHeader, source: str, limits: ImageLimits) -> None:
    """Check the blocks of an image that is read by windows, and the colours of a TIFF.

    Raises:
        ImageFormatError: the photometric interpretation is unsupported.
        ImageTooLargeError: a block of the image or of its mask is too large.
    """
    layout = header.tiff
    if layout is None:
        check_block(
            header.format,
            header.tile_px,
            samples=header.bands,
            sample_bytes=_OPENJPEG_SAMPLE_BYTES,
            limits=limits,
        )
        tile_bytes = block_bytes(
            header.tile_px, samples=header.bands, sample_bytes=_OPENJPEG_SAMPLE_BYTES
        )
        check_decoding_memory(
            f"{header.format}'s tiles",
            header.structure_bytes + tile_bytes,
            size=f"{header.tile_px} px",
            limits=limits,
        )
        return
    if layout.photometric not in _SUPPORTED_PHOTOMETRIC:
        raise ImageFormatError(
            f"the TIFF ({source}) has photometric interpretation {layout.photometric}, which is "
            "neither grey (black is zero), RGB, palette nor YCbCr; convert it to RGB"
        )
    # GDAL can read a strip that is the whole image in parts, so it decides about such a strip.
    if layout.block_px != header.width_px * header.height_px:
        _check_tiff_block(layout, limits)
    check_block("TIFF's mask", layout.mask_block_px, samples=1, sample_bytes=1, limits=limits)


def _check_tiff_block(layout: TiffLayout, limits: ImageLimits) -> None:
    """Check the largest strip or tile of a TIFF.

    Raises:
        ImageTooLargeError: it is too large.
    """
    check_block(
        "TIFF",
        layout.block_px,
        samples=1 if layout.planar else layout.bands,
        sample_bytes=layout.pixel_bytes // layout.bands,
        limits=limits,
    )


def _check_extra(header: ImageHeader, source: str, *, by_windows: bool) -> None:
    """Check that the package that reads the image is installed, without importing it.

    Raises:
        MissingExtraError: it is not.
    """
    image_format = IMAGE_FORMATS[header.format]
    extra = image_format.extra
    if extra is not None and not any(map(_is_installed, extra.modules)):
        raise missing_decoder(image_format.name, extra, source)
    if by_windows and not _is_installed("rasterio"):
        raise missing_rasterio(header, source)


def _is_installed(package: str) -> bool:
    return find_spec(package) is not None


def missing_decoder(name: str, extra: DecoderExtra, source: str) -> MissingExtraError:
    """Make the error for a file whose decoder is not installed.

    Args:
        name: name of the format.
        extra: extra with its decoder.
        source: name of the image in the message.
    """
    return MissingExtraError(
        f"reading a {name} ({source}) needs {extra.package}: {how_to_install(extra.name)}; "
        "or convert it to JPEG"
    )


def missing_rasterio(header: ImageHeader, source: str) -> MissingExtraError:
    """Make the error for a file that OpenCV does not decode; it says why this file needs rasterio.

    Args:
        header: header of the file.
        source: name of the image in the message.
    """
    if header.tiff is None:
        reason = "has a format that OpenCV does not decode safely"
    else:
        reason = "is georeferenced, too large or unsupported by OpenCV"
    return MissingExtraError(
        f"the {header.format} ({source}) {reason}; reading it needs rasterio: "
        f"{how_to_install('geo')}"
    )
