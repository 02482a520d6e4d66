"""Opening of any aerial image as a raster of 8-bit RGB.

OpenCV decodes most of ``IMAGE_FORMATS`` whole, TIFF only if it is plain. rasterio (extra ``geo``)
reads the following by windows: GeoTIFF, COG, JPEG 2000, and TIFF that is too large to decode whole
or that OpenCV cannot decode. libheif (extra ``heic``) decodes HEIC. The choice depends on the file
alone, never on installed packages (docs/decisions.md).
"""

from __future__ import annotations

import os
import stat
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

from vehanchor.errors import (
    ImageDecodeError,
    ImageNotFoundError,
    ImageTooLargeError,
    InvalidParameterError,
)
from vehanchor.imagery.formats.decoding import decode, decodes_tiff
from vehanchor.imagery.formats.header import image_format
from vehanchor.imagery.formats.heic import open_heic
from vehanchor.imagery.formats.ifd import in_memory
from vehanchor.imagery.limits import WINDOWED_FORMATS, check_bytes, read_checked_header
from vehanchor.imagery.metadata.camera import read_camera
from vehanchor.imagery.raster import Raster
from vehanchor.imagery.sources.arrays import ArrayRaster
from vehanchor.imagery.sources.files import existing
from vehanchor.imagery.sources.pillow import PillowImage, is_pillow, pillow_pixels
from vehanchor.imagery.sources.rasterio_file import Dataset, is_dataset, open_dataset, open_file
from vehanchor.options import ImageLimits, Reading

if TYPE_CHECKING:
    from vehanchor.imagery.bands import BandChoice
    from vehanchor.imagery.formats.ifd import ReadAt
    from vehanchor.imagery.formats.image_header import ImageHeader

ImageSource: TypeAlias = (
    str
    | os.PathLike[str]
    | bytes
    | bytearray
    | memoryview
    | BinaryIO
    | NDArray[Any]
    | Dataset
    | PillowImage
)
"""A path, an encoded image in memory, a binary file object, an array [h, w] or [h, w, bands] in RGB order, an open
rasterio dataset, or a Pillow image."""

_MIB = 1 << 20
_DEFAULT_READING = Reading()
_WITH_ALPHA = frozenset({"PNG", "WebP", "AVIF"})  # formats whose fourth band is alpha


def open_raster(image: ImageSource, reading: Reading = _DEFAULT_READING) -> Raster:
    """Open an image of any kind for reading by windows.

    uint8 stays unchanged. uint16 is stretched between percentiles 2 and 98 of the whole image.
    Floats within 0..1 are scaled by 255, other floats stretched by percentiles. Arrays and plain
    files must be finite; in files read by windows NaN means "no data". One band becomes grey.
    Pixels of alpha 0 are not seen. Of more bands the first three are used.

    Args:
        image: one of

            * a path to a local file,
            * an encoded image: bytes, or a binary file object, which is read from its current
              position,
            * an array [h, w] or [h, w, bands] of uint8, uint16 or floats, RGB; it is neither copied
              nor changed,
            * an open rasterio dataset, which stays open,
            * a Pillow image, whose EXIF orientation is applied.
        reading: bands, limits, and the order of an array's bands.

    Raises:
        InvalidParameterError: a band is missing, or ``image`` has an unknown type.
        ImageNotFoundError: there is no regular file at the path.
        ImageDecodeError: the file is empty, truncated, damaged, or not an image.
        ImageTooLargeError: the file has more bytes or declared pixels than the limits allow.
        ImageFormatError: the image decodes but cannot be measured: a side under 16 px, NaN, an
            unsupported dtype.
        MissingExtraError: the file needs rasterio or libheif, which is not installed.
    """
    bands = reading.bands
    limits = reading.limits
    if isinstance(image, np.ndarray):
        return ArrayRaster(image, "array", bands, bgr=reading.bgr)
    if isinstance(image, str | os.PathLike):
        return _open_path(existing(os.fspath(image)), bands, limits)
    if isinstance(image, bytes | bytearray | memoryview):
        check_bytes(memoryview(image).nbytes, limits)
        return _open_bytes(bytes(image), "bytes", bands=bands, limits=limits)
    if is_pillow(image):
        return ArrayRaster(pillow_pixels(image, limits), "image", bands, alpha=True)
    if is_dataset(image):
        return open_dataset(image, bands, limits)
    if hasattr(image, "read"):
        return _open_bytes(
            _read_stream(cast("BinaryIO", image), limits), "file", bands=bands, limits=limits
        )
    raise InvalidParameterError(
        "image must be a path, bytes, a binary file, a numpy array, a Pillow image or a "
        "rasterio dataset, got "
        f"{type(image).__name__}"
    )


def can_be_read_again(image: ImageSource) -> bool:
    """Test whether an image can be opened a second time; a stream cannot."""
    return not hasattr(image, "read") or is_dataset(image) or is_pillow(image)


def _open_path(path: str, bands: BandChoice, limits: ImageLimits) -> Raster:
    with _open_regular(path) as file:
        n_bytes = os.fstat(file.fileno()).st_size

        def read_at(offset: int, count: int) -> bytes:
            if offset >= n_bytes:  # also keeps invalid offsets from seek()
                return b""
            file.seek(offset)
            return file.read(count)

        header = None
        if image_format(read_at(0, 32)) in WINDOWED_FORMATS:
            header = read_checked_header(read_at, limits)
            if n_bytes > limits.max_bytes or _needs_windows(header, limits):
                return _open_by_windows(
                    str(Path(path).absolute()),
                    path,
                    header=header,
                    bands=bands,
                    limits=limits,
                    read_at=read_at,
                )
        check_bytes(n_bytes, limits)
        data = read_at(0, n_bytes)
    return _open_bytes(data, path, bands=bands, limits=limits, header=header)


def _open_bytes(
    data: bytes,
    source: str,
    bands: BandChoice,
    limits: ImageLimits,
    header: ImageHeader | None = None,
) -> Raster:
    check_bytes(len(data), limits)
    if not data:
        raise ImageDecodeError(f"the image ({source}) is empty: 0 bytes")
    if image_format(data[:32]) == "HEIC":
        return open_heic(data, source, bands=bands, limits=limits)
    read_at = in_memory(data)
    header = header or read_checked_header(read_at, limits)
    if _needs_windows(header, limits):
        return _open_by_windows(
            data, source, header=header, bands=bands, limits=limits, read_at=read_at
        )
    pixels = decode(data, source, header)
    # OpenCV has already applied a TIFF's orientation
    orientation = 1 if header.tiff else header.orientation
    alpha = header.tiff.alpha if header.tiff else header.format in _WITH_ALPHA
    raster = ArrayRaster(pixels, source, bands, bgr=True, orientation=orientation, alpha=alpha)
    raster.camera = read_camera(read_at, header)
    return raster


def _open_by_windows(
    file: str | bytes,
    source: str,
    header: ImageHeader,
    bands: BandChoice,
    limits: ImageLimits,
    read_at: ReadAt,
) -> Raster:
    """Open an image that is too large to decode whole, or that OpenCV does not decode."""
    raster = open_file(file, source, header=header, bands=bands, limits=limits)
    raster.encoded = file
    raster.camera = read_camera(read_at, header)
    return raster


def _needs_windows(header: ImageHeader, limits: ImageLimits) -> bool:
    if header.tiff is None:
        return header.format == "JPEG 2000"
    too_large = (
        header.width_px * header.height_px > limits.max_pixels
        or header.decoding_bytes > limits.max_decoded_bytes
    )
    return too_large or header.tiff.georeferenced or not decodes_tiff(header.tiff)


def _open_regular(path: str) -> BinaryIO:
    # O_NONBLOCK: opening a FIFO must not wait for a writer. The check uses the open file, because
    # its name can change.
    flags = (
        os.O_RDONLY
        | getattr(os, "O_NONBLOCK", 0)
        | getattr(os, "O_CLOEXEC", 0)
        | getattr(os, "O_BINARY", 0)
    )
    try:
        descriptor = os.open(path, flags)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = error.strerror if isinstance(error, OSError) else str(error)
        remedy = "; download it, or pass rasterio.open(...) of it" if "://" in path else ""
        raise ImageNotFoundError(f"cannot open the image {path!r}: {reason}{remedy}") from error
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    if stat.S_ISDIR(mode):
        raise ImageNotFoundError(
            f"{path!r} is a folder: give an image; vehanchor.find_images lists those in a folder"
        )
    kind = "a pipe" if stat.S_ISFIFO(mode) else "a device or socket"
    raise ImageNotFoundError(f"the image {path!r} is {kind}, not a file")


def _read_stream(stream: BinaryIO, limits: ImageLimits) -> bytes:
    chunks: list[bytes] = []
    n_bytes = 0
    while n_bytes <= limits.max_bytes:
        try:
            chunk = stream.read(min(_MIB, limits.max_bytes + 1 - n_bytes))
        except OSError as error:
            raise ImageDecodeError(
                f"cannot read the image from its file object: {error}"
            ) from error
        if not chunk:
            break
        if not isinstance(chunk, bytes):
            raise InvalidParameterError(
                f"the image's file object must be open in binary mode, got {type(chunk)}"
            )
        chunks.append(chunk)
        n_bytes += len(chunk)
    if n_bytes > limits.max_bytes:
        raise ImageTooLargeError(
            f"the image's file object exceeds the limit of {limits.max_bytes} bytes"
        )
    return b"".join(chunks)
