"""Opening of any aerial image as a raster of 8-bit RGB.

Three libraries read the formats of ``IMAGE_FORMATS``:

* OpenCV decodes most formats whole, but TIFF only if it is plain.
* rasterio (extra ``geo``) reads GeoTIFF, COG and JPEG 2000 by windows, and every TIFF that is too
  large to decode whole or that OpenCV cannot decode.
* libheif (extra ``heic``) decodes HEIC.

The choice depends on the file alone, never on installed packages (docs/decisions.md). Every encoded
image passes ``vehanchor.imagery.file_check`` first, which also lists the differences between the
ways in. Arrays and Pillow images have the limit of pixels of a file that is decoded whole.
"""

from __future__ import annotations

import math
import os
import stat
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray

from vehanchor.errors import (
    ImageDecodeError,
    ImageFormatError,
    ImageNotFoundError,
    InvalidParameterError,
    VehAnchorError,
)
from vehanchor.imagery.file_check import check_file
from vehanchor.imagery.formats.decoding import decode
from vehanchor.imagery.formats.header import FORMAT_BYTES, IMAGE_FORMATS, recognise_format
from vehanchor.imagery.formats.heic import open_heic
from vehanchor.imagery.formats.heif import HEIC
from vehanchor.imagery.formats.ifd import in_memory
from vehanchor.imagery.limits import check_bytes, check_whole_size
from vehanchor.imagery.metadata.camera import read_camera
from vehanchor.imagery.metadata.density import density_aspect
from vehanchor.imagery.metadata.georeference import (
    Ground,
    pixel_of_transform,
    shape_of_transform,
)
from vehanchor.imagery.metadata.sidecar_georeference import UnusableSidecarError
from vehanchor.imagery.raster import Raster, RasterNote, oriented
from vehanchor.imagery.sources.arrays import ArrayRaster, check_array_size, without_mask
from vehanchor.imagery.sources.files import spelled_as_stored
from vehanchor.imagery.sources.pillow import (
    PillowImage,
    is_pillow,
    pillow_orientation,
    pillow_pixels,
)
from vehanchor.imagery.sources.rasterio_file import Dataset, is_dataset, open_dataset, open_file
from vehanchor.imagery.sources.sidecars import Sidecars, unreadable_mask, unusable_coordinates
from vehanchor.imagery.square_raster import in_square_pixels
from vehanchor.imagery.thumbnail import with_crop_by_thumbnail
from vehanchor.options import Reading

if TYPE_CHECKING:
    from vehanchor.imagery.formats.ifd import ReadAt
    from vehanchor.imagery.formats.image_header import ImageHeader
    from vehanchor.imagery.sources.sidecars import SidecarGeoreference
    from vehanchor.options import ImageLimits

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
"""Everything that can be opened as an image:

* a path,
* an encoded image in memory,
* a binary file object,
* an array [h, w] or [h, w, bands] in RGB order,
* an open rasterio dataset,
* a Pillow image.
"""

_MIB = 1 << 20
# Start of an image in a data: address, in messages.
_SHOWN_CHARS = 32
_DEFAULT_READING = Reading()
DECODERS_OF_EXTRAS = {HEIC.name: open_heic}
"""Functions that decode the formats with an ``extra``, by name of the format."""


def open_raster(image: ImageSource, reading: Reading = _DEFAULT_READING) -> Raster:
    """Open an image of any kind for reading by windows.

    Every image is read as 8-bit RGB. uint8 stays unchanged. uint16 is stretched between percentiles
    2 and 98 of the whole image. Floats within 0..1 are scaled by 255, other floats stretched by
    percentiles. A single band becomes grey. Of more than three bands the first three are used.

    If the file states that its pixels are not square on the ground, the image is read in square
    pixels; see ``vehanchor.options.pixel_grid.PixelGrid``.

    Transparent pixels (alpha 0), those of a mask beside the file (``.msk``) and masked ones of a
    masked array are ignored. Arrays and files that are decoded whole must be
    finite. In files that are read by windows, NaN means "no data".

    Args:
        image: one of

            * a path to a local file,
            * an encoded image: bytes, or a binary file object, which is read from its current
              position,
            * an array [h, w] or [h, w, bands] of uint8, uint16 or floats, RGB; it is neither copied
              nor changed; a masked array is copied,
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
    raster = _open_in_file_pixels(image, reading)
    return in_square_pixels(raster, reading.limits)


def _open_in_file_pixels(image: ImageSource, reading: Reading) -> Raster:
    """Open an image of any kind, with the pixels of its file; see ``open_raster``."""
    if isinstance(image, np.ndarray):
        check_array_size(image, reading.limits)
        valid = None
        if isinstance(image, np.ma.MaskedArray):
            image, valid = without_mask(image)
        return ArrayRaster(image, "array", reading.bands, bgr=reading.bgr, valid=valid)
    if isinstance(image, str | os.PathLike):
        path = spelled_as_stored(os.fspath(image))
        return _open_path(path, reading)
    if isinstance(image, bytes | bytearray | memoryview):
        # The size is checked before a bytearray or memoryview is copied.
        n_bytes = memoryview(image).nbytes
        check_bytes(n_bytes, reading.limits.max_bytes)
        return _open_bytes(bytes(image), "bytes", reading)
    if is_pillow(image):
        pixels = pillow_pixels(image, reading.limits)
        raster = ArrayRaster(pixels, "image", reading.bands, alpha=True)
        raster.orientation = pillow_orientation(image)
        return raster
    if is_dataset(image):
        return open_dataset(image, reading.bands, reading.limits)
    if hasattr(image, "read"):
        stream = cast("BinaryIO", image)
        data = _read_stream(stream, reading.limits)
        return _open_bytes(data, "file", reading)
    raise InvalidParameterError(
        "image must be a path, bytes, a binary file, a numpy array, a Pillow image or a "
        f"rasterio dataset, got {type(image).__name__}"
    )


def can_be_read_again(image: ImageSource) -> bool:
    """Test whether an image can be opened a second time; a stream cannot."""
    # A dataset has a method ``read``, too, but no position that reading moves.
    is_stream = hasattr(image, "read") and not is_dataset(image) and not is_pillow(image)
    return not is_stream


def _open_path(path: str, reading: Reading) -> Raster:
    """Open a file; one that is read by windows is never loaded whole."""
    with _open_regular_file(path) as file:
        n_bytes = os.fstat(file.fileno()).st_size

        def read_at(offset: int, count: int) -> bytes:
            # A damaged header can name any offset, and seek() refuses some.
            if offset >= n_bytes:
                return b""
            file.seek(offset)
            return file.read(count)

        limits = reading.limits
        sidecars = Sidecars(path)
        image_format = recognise_format(read_at(0, FORMAT_BYTES))
        if image_format is not None and image_format.gdal_driver is not None:
            checked = check_file(read_at, n_bytes, path, limits=limits, on_disk=True)
            if checked.by_windows:
                # An absolute path has no prefix that GDAL interprets, such as GTIFF_DIR:.
                absolute = str(Path(path).absolute())
                return _open_by_windows(
                    absolute,
                    path,
                    header=checked.header,
                    reading=reading,
                    read_at=read_at,
                    sidecars=sidecars,
                )
        check_bytes(n_bytes, limits.max_bytes)
        data = read_at(0, n_bytes)
    # A file can change while it is read, so the check uses the bytes that will be decoded.
    return _open_bytes(data, path, reading, sidecars)


def _open_bytes(
    data: bytes, source: str, reading: Reading, sidecars: Sidecars | None = None
) -> Raster:
    """Open an encoded image in memory, with the files beside it if it has a folder."""
    read_at = in_memory(data)
    checked = check_file(read_at, len(data), source, limits=reading.limits, on_disk=False)
    header = checked.header
    if header.format in DECODERS_OF_EXTRAS:
        decode_by_extra = DECODERS_OF_EXTRAS[header.format]
        raster = decode_by_extra(data, source, bands=reading.bands, limits=reading.limits)
        raster.camera = read_camera(read_at, header)
        return raster
    if checked.by_windows:
        return _open_by_windows(
            data,
            source,
            header=header,
            reading=reading,
            read_at=read_at,
            sidecars=sidecars,
        )
    pixels = decode(data, source, header)
    if header.tiff is None:
        orientation = header.orientation
        has_alpha = IMAGE_FORMATS[header.format].has_alpha
    else:
        orientation = 1  # OpenCV has already applied a TIFF's orientation.
        has_alpha = header.tiff.alpha
    valid, notes = _read_sidecars(sidecars, header, reading.limits)
    if valid is not None and header.tiff is not None:
        valid = oriented(valid, header.orientation)
    raster = ArrayRaster(
        pixels,
        source,
        reading.bands,
        bgr=True,
        orientation=orientation,
        alpha=has_alpha,
        valid=valid,
    )
    raster.orientation = header.orientation
    raster.warnings = (*raster.warnings, *notes)
    camera = read_camera(read_at, header)
    raster.camera = with_crop_by_thumbnail(camera, raster, read_at, header)
    _georeference_by_sidecars(raster, sidecars)
    _read_density(raster, read_at, header)
    return raster


def _open_by_windows(
    file: str | bytes,
    source: str,
    *,
    header: ImageHeader,
    reading: Reading,
    read_at: ReadAt,
    sidecars: Sidecars | None,
) -> Raster:
    """Open an image that is too large to decode whole, or that OpenCV does not decode."""
    valid, notes = _read_sidecars(sidecars, header, reading.limits)
    raster = open_file(
        file,
        source,
        header=header,
        bands=reading.bands,
        limits=reading.limits,
        valid=valid,
    )
    raster.warnings = (*raster.warnings, *notes)
    raster.encoded = file
    raster.camera = read_camera(read_at, header)
    _georeference_by_sidecars(raster, sidecars)
    _read_density(raster, read_at, header)
    return raster


def _read_density(raster: Raster, read_at: ReadAt, header: ImageHeader) -> None:
    """Read the hint at the shape of a pixel, unless a georeference states its shape."""
    if raster.georeference_gsd_m_per_px is None:
        raster.density_aspect = density_aspect(read_at, header)


def _georeference_by_sidecars(raster: Raster, sidecars: Sidecars | None) -> None:
    """Georeference an image by the files beside it, unless its own file does."""
    if sidecars is None or raster.ground is not None:
        return
    try:
        _georeference(raster, sidecars.georeference())
    except UnusableSidecarError as error:
        note = unusable_coordinates(str(error))
        raster.warnings = (*raster.warnings, note)


def _georeference(raster: Raster, stated: SidecarGeoreference | None) -> None:
    """Georeference an image by a transform of its stored pixels.

    Raises:
        UnusableSidecarError: the transform does not lead to the Earth, or its reference system is
            unknown; then it still gives the shape of a pixel.
    """
    if stated is None:
        return
    from affine import Affine

    # The files state the place of the stored pixels: the turn to the upright frame comes first.
    origin = np.array(raster.stored_point(0, 0))
    across = np.array(raster.stored_point(1, 0)) - origin
    down = np.array(raster.stored_point(0, 1)) - origin
    to_stored = np.column_stack([across, down, origin])
    coefficients = np.reshape(stated.transform, (2, 3))
    placed = coefficients[:, :2] @ to_stored
    placed[:, 2] += coefficients[:, 2]
    transform = Affine(*placed.ravel().tolist())
    size = {"width_px": raster.width_px, "height_px": raster.height_px}
    if stated.system is None:
        shape = shape_of_transform(transform, **size)
        if shape is not None:
            raster.take_shape(shape)
        raise UnusableSidecarError(stated.lack)
    ground = Ground(transform, stated.system)
    pixel = pixel_of_transform(transform, stated.system, **size)
    if pixel is None:
        raise UnusableSidecarError("the coordinates are not those of the stated reference system")
    raster.georeference(pixel, ground)


def _read_sidecars(
    sidecars: Sidecars | None, header: ImageHeader, limits: ImageLimits
) -> tuple[NDArray[np.bool_] | None, tuple[RasterNote, ...]]:
    """Read the mask beside an image, and name other files that are not used.

    Returns:
        ``[h, w]`` whether a stored pixel holds data, None without a mask; and notices.
    """
    notes = _unused_pages(header)
    if sidecars is None:
        return None, notes
    data = sidecars.mask(limits.max_bytes)
    if data is None:
        return None, notes
    try:
        with _open_bytes(data, "mask", Reading(limits=limits)) as mask:
            check_whole_size("mask", mask.width_px, height_px=mask.height_px, limits=limits)
            valid = mask.is_nonzero()
        if valid.shape != (header.height_px, header.width_px):
            raise ImageFormatError("its size is not that of the image")
    except VehAnchorError as error:
        return None, (*notes, unreadable_mask(error))
    return valid, notes


def _unused_pages(header: ImageHeader) -> tuple[RasterNote, ...]:
    """Warn of further pages of a TIFF or frames of an animation, of which the first is read."""
    if header.n_frames > 1:
        message = (
            f"The file is an animation of {header.n_frames} pictures, and only the first one is "
            "read. Save the picture that you mean as a file of its own."
        )
        return (RasterNote("pages_unused", message),)
    if header.tiff is None or not header.tiff.other_pages:
        return ()
    pages = header.tiff.other_pages
    width_px, height_px = max(pages, key=math.prod)
    message = (
        f"The file has {len(pages) + 1} pages, and only the first one, {header.width_px} x "
        f"{header.height_px} px, is read; the largest other one has {width_px} x {height_px} px. "
        "Save the page that you mean as a file of its own."
    )
    return (RasterNote("pages_unused", message),)


def _open_regular_file(path: str) -> BinaryIO:
    """Open a file for reading; refuse folders, pipes, devices and sockets."""
    # O_NONBLOCK: opening a FIFO must not wait for a writer. The check of the kind uses the open
    # file, because the file behind its name can change.
    flags = (
        os.O_RDONLY
        | getattr(os, "O_NONBLOCK", 0)
        | getattr(os, "O_CLOEXEC", 0)
        | getattr(os, "O_BINARY", 0)
    )
    try:
        descriptor = os.open(path, flags)
    except OSError as error:
        raise _cannot_open(path, error.strerror) from error
    except ValueError as error:  # a NUL in the name
        raise _cannot_open(path, str(error)) from error
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


def _cannot_open(path: str, reason: str | None) -> ImageNotFoundError:
    """Make the error for a path that the system cannot open; for an address, name the remedy."""
    address = path.lower()
    if address.startswith("data:"):
        start = path[:_SHOWN_CHARS]
        return ImageNotFoundError(
            f"cannot open the image '{start}...': this is no path; decode its base64, and save it "
            "or pass the bytes"
        )
    message = f"cannot open the image {path!r}: {reason}"
    if address.startswith("file:"):
        message += "; give the path alone, without file://"
    elif "://" in path:
        message += "; download it, or pass rasterio.open(...) of it"
    return ImageNotFoundError(message)


def _read_stream(stream: BinaryIO, limits: ImageLimits) -> bytes:
    """Read a file object to its end, or to one byte above the limit."""
    chunks: list[bytes] = []
    n_bytes = 0
    while n_bytes <= limits.max_bytes:
        chunk_bytes = min(_MIB, limits.max_bytes + 1 - n_bytes)
        try:
            chunk = stream.read(chunk_bytes)
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
    check_bytes(n_bytes, limits.max_bytes)
    return b"".join(chunks)
