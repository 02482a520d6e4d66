"""Any aerial image as a raster of 8-bit RGB that is read by windows.

JPEG, PNG, WebP, BMP and plain TIFF are decoded whole by OpenCV. GeoTIFF and COG, TIFF that OpenCV cannot decode (more
than four bands, say) and TIFF too large to decode whole are read by windows through rasterio (extra ``geo``). Which of
the two reads a file depends on the file alone, never on whether rasterio is installed.
"""

from __future__ import annotations

import math
import os
import stat
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO, NamedTuple, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from vehanchor.errors import (
    ImageDecodeError,
    ImageFormatError,
    ImageNotFoundError,
    ImageTooLargeError,
    InvalidParameterError,
    MissingExtraError,
)
from vehanchor.imagery.georeference import dataset_gsd_m_per_px
from vehanchor.imagery.header import ImageHeader, ReadAt, TiffLayout, is_tiff, read_header
from vehanchor.options import ImageLimits

__all__ = ["MIN_SIDE_PX", "ImageSource", "Raster", "RasterNote", "Window", "open_raster"]

ImageSource: TypeAlias = str | os.PathLike[str] | bytes | bytearray | memoryview | BinaryIO | NDArray[Any]
"""A path, an encoded image in memory, a binary file object, or an array [h, w] or [h, w, bands] with RGB order."""

MIN_SIDE_PX = 16
"""Smallest side of an image that can be measured: a car of 5 m is 17 px long at 0.3 m/px, the coarsest scale of use."""

STRETCH_PERCENTILES = (2.0, 98.0)
"""Percentiles of the whole image shown as 0 and 255, the cut that GIS viewers use. One range for all three bands:
colours keep their balance."""

SAMPLE_PX = 1 << 20
"""Pixels from which the percentiles are taken at most; smaller images give all of theirs."""

_SAMPLE_GRID = 8  # windows a side in a windowed raster: 64 spots of 128 px make SAMPLE_PX
_DTYPES = (np.uint8, np.uint16, np.float32, np.float64)  # what stored pixels are read as
_MIB = 1 << 20


@dataclass(frozen=True)
class Window:
    """A rectangle of pixels in the oriented frame; (x_px, y_px) is its top left pixel."""

    x_px: int
    y_px: int
    width_px: int
    height_px: int


class RasterNote(NamedTuple):
    """Something about the image that its user should know: ``bands_selected`` or ``pixels_stretched``."""

    code: str
    message: str


class _Stretch(NamedTuple):
    """The stored values shown as 0 and 255."""

    low: float
    high: float


class _Stored(NamedTuple):
    """Pixels as stored: [h, w, 3] RGB of any of _DTYPES, and which of them hold data (None: all)."""

    rgb: NDArray[Any]
    valid: NDArray[np.bool_] | None


class Raster(ABC):
    """An open image. Reads are safe from any thread, but from one at a time; close it, or use it as a context manager.

    Attributes:
        width_px: width of the oriented frame.
        height_px: height of the oriented frame.
        source: the path as given, or "bytes", "file", "array".
        georeference_gsd_m_per_px: the scale that the file itself carries, None without one.
        warnings: what its user should know.
    """

    def __init__(
        self,
        source: str,
        stored_width_px: int,
        stored_height_px: int,
        *,
        orientation: int = 1,
        georeference_gsd_m_per_px: float | None = None,
        notes: tuple[RasterNote, ...] = (),
    ) -> None:
        swapped = _ORIENTATIONS[orientation][0]
        self.width_px = stored_height_px if swapped else stored_width_px
        self.height_px = stored_width_px if swapped else stored_height_px
        self.source = source
        self.georeference_gsd_m_per_px = georeference_gsd_m_per_px
        self.warnings = notes
        self._orientation = orientation
        self._stretch: _Stretch | None = None

    def read(self, window: Window | None = None) -> NDArray[np.uint8]:
        """Read a window, or everything: [h, w, 3] uint8 RGB, contiguous; pixels without data are black.

        The result may be a read-only view of the caller's own array where nothing had to be converted.

        Raises:
            InvalidParameterError: the window is empty or not wholly inside.
            ImageDecodeError: the file is damaged here (rasters read by windows).
            ImageFormatError: the values here cannot be shown.
        """
        if window is None:
            window = Window(0, 0, self.width_px, self.height_px)
        elif not (
            0 <= window.x_px < window.x_px + window.width_px <= self.width_px
            and 0 <= window.y_px < window.y_px + window.height_px <= self.height_px
        ):
            raise InvalidParameterError(f"{window} is not inside the image of {self.width_px} x {self.height_px} px")
        rgb, valid = self._read_stored(_stored_window(window, self.width_px, self.height_px, self._orientation))
        shown = _to_uint8(rgb, self._stretch)
        if valid is not None:
            shown[~valid] = 0
        return np.ascontiguousarray(_orient(shown, self._orientation))

    def close(self) -> None:  # noqa: B027 - most rasters hold nothing to close
        """Release the file."""

    def __enter__(self) -> Raster:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    @abstractmethod
    def _read_stored(self, window: Window) -> _Stored:
        """The pixels of a window of the stored frame."""

    def _choose_stretch(self, sample: NDArray[Any]) -> None:
        """Decide from stored values (any shape) how all of them are shown."""
        self._stretch = _stretch_of(sample)
        if self._stretch not in (None, _UNIT_RANGE):
            low, high = self._stretch or _UNIT_RANGE
            message = (
                f"{sample.dtype} values {low:g} to {high:g} (percentiles {STRETCH_PERCENTILES[0]:g} and"
                f" {STRETCH_PERCENTILES[1]:g}) are shown as 0 to 255"
            )
            self.warnings = (*self.warnings, RasterNote("pixels_stretched", message))


def open_raster(
    image: ImageSource, *, bands: tuple[int, int, int] | None = None, limits: ImageLimits | None = None
) -> Raster:
    """Open an image of any kind for reading by windows.

    uint8 is taken as it is. uint16 is stretched by the percentiles 2 and 98 of the whole image. Floats within 0..1 are
    scaled by 255, all others stretched by percentiles; arrays and plain files must be finite, while in files read by
    windows NaN is "no data". One band becomes grey, alpha is dropped, of more bands the first three are taken.

    Args:
        image: a path to a local file, an encoded image (bytes or a binary file object, read from where it stands), or
            an array [h, w] or [h, w, bands], RGB, of uint8, uint16 or floats; arrays are neither copied nor changed.
        bands: which bands are red, green and blue; they count from 1.
        limits: what to refuse; None stands for the defaults.

    Raises:
        InvalidParameterError: ``bands`` names a band that is not there, or ``image`` is of no known kind.
        ImageNotFoundError: no regular file at the path.
        ImageDecodeError: empty, truncated, damaged, or not an image.
        ImageTooLargeError: more bytes or declared pixels than the limits allow.
        ImageFormatError: it decodes but cannot be measured: under 16 px a side, NaN, an odd dtype.
        MissingExtraError: the file needs rasterio, which is not installed.
    """
    limits = limits or ImageLimits()
    if bands is not None and (len(bands) != 3 or not all(isinstance(band, int) and band >= 1 for band in bands)):
        raise InvalidParameterError(f"bands must be three numbers from 1 up, got {bands!r}")
    if isinstance(image, np.ndarray):
        return _ArrayRaster(image, "array", bands)
    if isinstance(image, str | os.PathLike):
        return _open_path(os.fspath(image), bands, limits)
    if isinstance(image, bytes | bytearray | memoryview):
        _check_bytes(memoryview(image).nbytes, limits)
        return _open_bytes(bytes(image), "bytes", bands, limits)
    if hasattr(image, "read"):
        return _open_bytes(_read_stream(image, limits), "file", bands, limits)
    raise InvalidParameterError(
        f"image must be a path, bytes, a binary file or a numpy array, got {type(image).__name__}"
    )


# --- Where the bytes come from ---------------------------------------------------------------------------------------


def _open_path(path: str, bands: tuple[int, int, int] | None, limits: ImageLimits) -> Raster:
    with _open_regular(path) as file:
        n_bytes = os.fstat(file.fileno()).st_size

        def read_at(offset: int, count: int) -> bytes:
            if offset >= n_bytes:  # also keeps offsets that no file system knows from seek()
                return b""
            file.seek(offset)
            return file.read(count)

        if is_tiff(read_at(0, 4)):
            header = _checked_header(read_at, limits)
            if n_bytes > limits.max_bytes or _needs_windows(header, limits):
                return _open_windowed(str(Path(path).absolute()), path, header, bands, limits)
        _check_bytes(n_bytes, limits)
        data = read_at(0, n_bytes)
    return _open_bytes(data, path, bands, limits)


def _open_regular(path: str) -> BinaryIO:
    # O_NONBLOCK: opening a FIFO must not wait for a writer. What was opened is checked, not what the name meant before.
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
    try:
        descriptor = os.open(path, flags)
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = error.strerror if isinstance(error, OSError) else str(error)
        raise ImageNotFoundError(f"cannot open the image {path!r}: {reason}") from error
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    kind = "a directory" if stat.S_ISDIR(mode) else "a pipe" if stat.S_ISFIFO(mode) else "a device or socket"
    raise ImageNotFoundError(f"the image {path!r} is {kind}, not a file")


def _read_stream(stream: BinaryIO, limits: ImageLimits) -> bytes:
    chunks: list[bytes] = []
    n_bytes = 0
    while n_bytes <= limits.max_bytes:
        try:
            chunk = stream.read(min(_MIB, limits.max_bytes + 1 - n_bytes))
        except OSError as error:
            raise ImageDecodeError(f"cannot read the image from its file object: {error}") from error
        if not chunk:
            break
        if not isinstance(chunk, bytes):
            raise InvalidParameterError(f"the image's file object must be open in binary mode, it gave {type(chunk)}")
        chunks.append(chunk)
        n_bytes += len(chunk)
    if n_bytes > limits.max_bytes:
        raise ImageTooLargeError(f"the image's file object gives more than the limit of {limits.max_bytes} bytes")
    return b"".join(chunks)


def _open_bytes(data: bytes, source: str, bands: tuple[int, int, int] | None, limits: ImageLimits) -> Raster:
    _check_bytes(len(data), limits)
    if not data:
        raise ImageDecodeError(f"the image ({source}) is empty: 0 bytes")
    header = _checked_header(lambda offset, count: data[offset : offset + count], limits)
    if _needs_windows(header, limits):
        return _open_windowed(data, source, header, bands, limits)
    if not header.complete:
        raise ImageDecodeError(f"the {header.format} ({source}) is truncated: its end mark is missing")
    # OpenCV turns TIFFs by their orientation tag even when told to leave the image unchanged, and nothing else.
    orientation = 1 if header.tiff else header.orientation
    return _ArrayRaster(_decode(data, source, header), source, bands, bgr=True, orientation=orientation)


# --- Checks on what the header declares ------------------------------------------------------------------------------


def _check_bytes(n_bytes: int, limits: ImageLimits) -> None:
    if n_bytes > limits.max_bytes:
        raise ImageTooLargeError(f"the image has {n_bytes} bytes, the limit is {limits.max_bytes}")


def _check_side(width_px: int, height_px: int, hint: str = "") -> None:
    if min(width_px, height_px) < MIN_SIDE_PX:
        raise ImageFormatError(
            f"the image is {width_px} x {height_px} px; at least {MIN_SIDE_PX} px a side are needed{hint}"
        )


def _checked_header(read_at: ReadAt, limits: ImageLimits) -> ImageHeader:
    header = read_header(read_at)
    declared = f"the {header.format} declares {header.width_px} x {header.height_px} px"
    n_pixels = header.width_px * header.height_px
    if header.tiff is None and n_pixels > limits.max_pixels:
        raise ImageTooLargeError(
            f"{declared}, the limit is {limits.max_pixels} pixels; convert it to a tiled TIFF, which is read by windows"
        )
    if n_pixels > limits.max_windowed_pixels:
        raise ImageTooLargeError(f"{declared}, the limit is {limits.max_windowed_pixels} pixels")
    _check_side(header.width_px, header.height_px)
    return header


def _needs_windows(header: ImageHeader, limits: ImageLimits) -> bool:
    if header.tiff is None:
        return False
    too_large = header.width_px * header.height_px > limits.max_pixels
    return too_large or header.tiff.georeferenced or not _opencv_decodes(header.tiff)


def _opencv_decodes(layout: TiffLayout) -> bool:
    """Whether OpenCV decodes such a TIFF without loss or misreading."""
    if layout.bands not in (1, 3, 4) or layout.planar:
        return False
    bits = set(layout.bits)
    if layout.sample_format == 3:
        return bits in ({32}, {64}) and layout.photometric in (1, 2)
    white_is_zero = layout.photometric == 0 and bits in ({1}, {8})
    return (
        layout.sample_format == 1 and bits in ({1}, {8}, {16}) and (white_is_zero or layout.photometric in (1, 2, 3, 6))
    )


# --- Decoded whole ---------------------------------------------------------------------------------------------------


def _decode(data: bytes, source: str, header: ImageHeader) -> NDArray[Any]:
    """Decode with OpenCV: [h, w] or [h, w, 3 or 4] in BGR order, depth as stored."""
    try:
        with _quiet_opencv():
            pixels = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise ImageDecodeError(f"the {header.format} ({source}) cannot be decoded: {error.err}") from error
    # None is in no older OpenCV's type of the result, but in every one's behaviour.
    if pixels is None or sorted(pixels.shape[:2]) != sorted((header.height_px, header.width_px)):
        raise ImageDecodeError(f"the {header.format} ({source}) cannot be decoded: truncated or damaged")
    return pixels


@contextmanager
def _quiet_opencv() -> Iterator[None]:
    """Keep OpenCV from writing to stderr about files that we report by an error of our own."""
    logging: Any = getattr(cv2.utils, "logging", cv2)  # OpenCV 5 moved the two functions
    before = logging.setLogLevel(0)
    try:
        yield
    finally:
        logging.setLogLevel(before)


class _ArrayRaster(Raster):
    """Pixels in memory; windows are converted one by one, so that nothing is held twice."""

    def __init__(
        self,
        pixels: NDArray[Any],
        source: str,
        bands: tuple[int, int, int] | None,
        *,
        bgr: bool = False,
        orientation: int = 1,
    ) -> None:
        pixels = _checked_array(pixels)
        height, width, n_bands = pixels.shape
        channels, notes = _select_bands(n_bands, bands)
        super().__init__(source, width, height, orientation=orientation, notes=notes)
        stored = (2, 1, 0, 3) if bgr and n_bands >= 3 else tuple(range(n_bands))
        self._channels = tuple(stored[channel] for channel in channels)
        self._pixels = pixels
        if pixels.dtype != np.uint8:
            for channel in sorted(set(self._channels)):
                _check_finite(pixels[:, :, channel])
            step = math.ceil(math.sqrt(width * height / SAMPLE_PX))
            self._choose_stretch(pixels[::step, ::step][:, :, list(self._channels)])

    def _read_stored(self, window: Window) -> _Stored:
        part = self._pixels[
            window.y_px : window.y_px + window.height_px, window.x_px : window.x_px + window.width_px
        ].view()
        part.flags.writeable = False
        if self._channels == (0, 1, 2) and part.shape[2] == 3:
            return _Stored(part, None)
        return _Stored(_merge([part[:, :, channel] for channel in self._channels]), None)


def _checked_array(pixels: NDArray[Any]) -> NDArray[Any]:
    """The array as [h, w, bands] of one of _DTYPES, without a copy where it is one already."""
    pixels = np.asarray(pixels)
    if pixels.ndim == 2:
        pixels = pixels[:, :, np.newaxis]
    if pixels.ndim != 3 or pixels.shape[2] == 0:
        raise ImageFormatError(f"an image array has the shape [h, w] or [h, w, bands], got {list(pixels.shape)}")
    hint = "; an array's bands come last" if pixels.shape[0] in (1, 3, 4) else ""
    _check_side(pixels.shape[1], pixels.shape[0], hint)
    dtype = np.dtype(np.float32) if pixels.dtype == np.float16 else pixels.dtype.newbyteorder("=")
    _check_dtype(dtype)
    return pixels.astype(dtype, copy=False)


def _check_dtype(dtype: np.dtype[Any]) -> None:
    if dtype not in _DTYPES:
        raise ImageFormatError(f"pixels of {dtype} cannot be measured; convert them to uint8, uint16 or float32")


def _check_finite(values: NDArray[Any]) -> None:
    if values.dtype.kind == "f":
        n_bad = values.size - int(np.count_nonzero(np.isfinite(values)))
        if n_bad:
            raise ImageFormatError(f"{n_bad} of {values.size} pixels are NaN or infinite; fill them before measuring")


# --- Read by windows -------------------------------------------------------------------------------------------------


def _open_windowed(
    file: str | bytes, source: str, header: ImageHeader, bands: tuple[int, int, int] | None, limits: ImageLimits
) -> Raster:
    """Open a TIFF, by absolute path or in memory, through rasterio; nothing beside it is looked at."""
    rasterio = _import_rasterio(source)
    layout = header.tiff
    if layout is None or layout.photometric not in (1, 2, 3, 6):
        raise ImageFormatError(
            f"the TIFF ({source}) has photometric interpretation {layout and layout.photometric}, which is neither"
            " grey (black is zero), RGB, palette nor YCbCr; convert it to RGB"
        )
    with ExitStack() as stack:
        # Sidecar files (.aux.xml, .ovr, .msk, .tfw) could change what the file says, a VRT could name any other file.
        with (
            _gdal(source, GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR", GDAL_PAM_ENABLED="NO"),
            warnings.catch_warnings(),
        ):
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            if isinstance(file, bytes):
                file = stack.enter_context(rasterio.MemoryFile(file)).name
            dataset = stack.enter_context(rasterio.open(file, driver="GTiff", sharing=False, GEOREF_SOURCES="INTERNAL"))
            if (dataset.width, dataset.height) != (header.width_px, header.height_px):
                raise ImageDecodeError(f"the TIFF ({source}) declares two different sizes: damaged")
            _check_block(dataset, limits)
            # A geotransform speaks of the stored frame: such files are shown as stored.
            orientation = 1 if layout.georeferenced else header.orientation
            raster = _WindowedRaster(dataset, source, bands, orientation, stack)
        stack.pop_all()
    return raster


def _import_rasterio(source: str) -> Any:
    try:
        import rasterio
        import rasterio.enums
        import rasterio.errors
    except ImportError as error:
        raise MissingExtraError(
            f"the TIFF ({source}) is georeferenced, too large or of too many bands for OpenCV; reading it needs"
            " rasterio: pip install 'vehanchor[geo]'"
        ) from error
    return rasterio


@contextmanager
def _gdal(source: str, **options: str) -> Iterator[None]:
    """Run GDAL with these options, silent on stderr, its errors as ours."""
    from rasterio import Env
    from rasterio._err import CPLE_BaseError
    from rasterio.errors import RasterioError

    try:
        with Env(**options):
            yield
    except (RasterioError, CPLE_BaseError, OSError) as error:  # rasterio 1.3: RasterioIOError is only an OSError
        cause = error.__cause__ or error
        raise ImageDecodeError(f"the TIFF ({source}) cannot be decoded: {cause}") from error


def _check_block(dataset: Any, limits: ImageLimits) -> None:
    """A window is decoded from whole blocks: one block must not be what the limits were to prevent."""
    height, width = max(dataset.block_shapes)
    per_block = dataset.count if dataset.profile.get("interleave") == "pixel" else 1
    if height * width * per_block > 4 * limits.max_pixels:
        raise ImageTooLargeError(
            f"the TIFF is stored in blocks of {width} x {height} px with {per_block} bands, too large to read by"
            f" windows under the limit of {limits.max_pixels} pixels; store it tiled"
        )


class _WindowedRaster(Raster):
    """A TIFF read through rasterio."""

    def __init__(
        self, dataset: Any, source: str, bands: tuple[int, int, int] | None, orientation: int, stack: ExitStack
    ) -> None:
        self._palette = _palette(dataset)
        if self._palette is not None:
            channels, notes = _select_bands(3, bands)
            self._palette = self._palette[:, list(channels)]
            self._indexes = [1, 1, 1]
        else:
            channels, notes = _select_bands(dataset.count, bands)
            self._indexes = [channel + 1 for channel in channels]
        super().__init__(
            source,
            dataset.width,
            dataset.height,
            orientation=orientation,
            georeference_gsd_m_per_px=dataset_gsd_m_per_px(dataset),
            notes=notes,
        )
        dtype = np.dtype(dataset.dtypes[self._indexes[0] - 1])
        _check_dtype(dtype)
        self._dataset = dataset
        self._unique = sorted(set(self._indexes))
        flags = [{flag.name for flag in dataset.mask_flag_enums[index - 1]} for index in self._unique]
        self._masked = any("all_valid" not in names for names in flags)
        self._stack = stack.pop_all()
        if dtype != np.uint8 and self._palette is None:
            self._choose_stretch(self._sample())

    def close(self) -> None:
        """Close the file."""
        self._stack.close()

    def _read_stored(self, window: Window) -> _Stored:
        bounds = (
            (window.y_px, window.y_px + window.height_px),
            (window.x_px, window.x_px + window.width_px),
        )
        with _gdal(self.source):
            planes = dict(zip(self._unique, self._dataset.read(self._unique, window=bounds), strict=True))
            masks = self._dataset.read_masks(self._unique, window=bounds) if self._masked else None
        # With "nodata = 0" a band is without data wherever it is dark: only where all are is there no picture.
        valid: NDArray[np.bool_] | None = None if masks is None else masks.any(axis=0)
        if self._palette is not None:
            return _Stored(self._palette[planes[1]], valid)
        rgb = _merge([planes[index] for index in self._indexes])
        if rgb.dtype.kind == "f":
            finite = np.isfinite(rgb).all(axis=2)
            valid = finite if valid is None else valid & finite
            rgb[~valid] = 0
        return _Stored(rgb, valid)

    def _sample(self) -> NDArray[Any]:
        """Values [n, 3] with data: all of a small raster, else a grid of windows (never the whole of a huge file)."""
        width, height = self._dataset.width, self._dataset.height
        if width * height <= SAMPLE_PX:
            windows = [Window(0, 0, width, height)]
        else:
            side = math.isqrt(SAMPLE_PX) // _SAMPLE_GRID
            spots = np.linspace(0, 1, _SAMPLE_GRID)
            w, h = min(side, width), min(side, height)
            windows = [Window(int(x * (width - w)), int(y * (height - h)), w, h) for y in spots for x in spots]
        parts = [self._read_stored(window) for window in windows]
        return np.concatenate(
            [part.rgb.reshape(-1, 3) if part.valid is None else part.rgb[part.valid] for part in parts]
        )


def _palette(dataset: Any) -> NDArray[np.uint8] | None:
    """The colours of a palette image, [values, 3]; None for all other images."""
    if dataset.count != 1 or dataset.colorinterp[0].name != "palette":
        return None
    colours = np.zeros((1 << 16 if dataset.dtypes[0] == "uint16" else 1 << 8, 3), np.uint8)
    for value, (red, green, blue, _) in dataset.colormap(1).items():
        colours[value] = red, green, blue
    return colours


# --- Pure functions on arrays ----------------------------------------------------------------------------------------

_UNIT_RANGE = _Stretch(0.0, 1.0)

# EXIF orientation -> (rows and columns swap, then flip up-down, flip left-right) that shows the stored image upright.
_ORIENTATIONS = {
    1: (False, False, False),
    2: (False, False, True),
    3: (False, True, True),
    4: (False, True, False),
    5: (True, False, False),
    6: (True, False, True),
    7: (True, True, True),
    8: (True, True, False),
}


def _orient(stored: NDArray[np.uint8], orientation: int) -> NDArray[np.uint8]:
    """Turn a stored image [h, w, 3] upright, as a view."""
    swap, up_down, left_right = _ORIENTATIONS[orientation]
    turned = stored.swapaxes(0, 1) if swap else stored
    return turned[:: -1 if up_down else 1, :: -1 if left_right else 1]


def _stored_window(window: Window, width_px: int, height_px: int, orientation: int) -> Window:
    """Where a window of the oriented frame, width_px x height_px, lies in the stored one."""
    swap, up_down, left_right = _ORIENTATIONS[orientation]
    x = width_px - window.x_px - window.width_px if left_right else window.x_px
    y = height_px - window.y_px - window.height_px if up_down else window.y_px
    if swap:
        return Window(y, x, window.height_px, window.width_px)
    return Window(x, y, window.width_px, window.height_px)


def _select_bands(
    n_bands: int, bands: tuple[int, int, int] | None
) -> tuple[tuple[int, int, int], tuple[RasterNote, ...]]:
    """Red, green and blue as bands counted from 0, and what to tell about the choice."""
    if bands is not None:
        if max(bands) > n_bands:
            raise InvalidParameterError(f"bands={bands!r} asks for more than the image has: {n_bands}")
        return (bands[0] - 1, bands[1] - 1, bands[2] - 1), ()
    if n_bands < 3:  # the second of two is alpha
        return (0, 0, 0), ()
    if n_bands <= 4:  # the fourth is alpha or near infrared
        return (0, 1, 2), ()
    message = f"the image has {n_bands} bands; the first three are read as red, green and blue: choose with bands"
    return (0, 1, 2), (RasterNote("bands_selected", message),)


def _merge(planes: list[NDArray[Any]]) -> NDArray[Any]:
    """Three bands [h, w] as one contiguous [h, w, 3]."""
    return cv2.merge([np.ascontiguousarray(plane) for plane in planes])


def _stretch_of(sample: NDArray[Any]) -> _Stretch | None:
    """Which values of a sample become 0 and 255; None where the values are shown as they are."""
    if sample.dtype == np.uint8:
        return None
    if sample.size == 0:  # no data anywhere: every choice shows black
        return _UNIT_RANGE
    least, most = float(sample.min()), float(sample.max())
    if sample.dtype.kind == "f" and least >= 0 and most <= 1:
        return _UNIT_RANGE
    # "nearest": no arithmetic between values, so that the largest floats do not overflow
    low, high = (float(value) for value in np.percentile(sample, STRETCH_PERCENTILES, method="nearest"))
    if low == high:
        low, high = least, most
    if low == high:
        high = low + max(1.0, abs(low))  # constant: all black
    if not math.isfinite(255 / (high - low)) or math.isinf(high - low):
        raise ImageFormatError(f"pixel values from {low:g} to {high:g} cannot be scaled; rescale the image to 0..1")
    return _Stretch(low, high)


def _to_uint8(pixels: NDArray[Any], stretch: _Stretch | None) -> NDArray[np.uint8]:
    if stretch is None:
        return pixels
    if pixels.dtype == np.uint16:
        table = _scale(np.arange(1 << 16, dtype=np.float64), stretch)
        shown: NDArray[np.uint8] = table[pixels]
        return shown
    return _scale(pixels.astype(np.float64), stretch)


def _scale(values: NDArray[np.float64], stretch: _Stretch) -> NDArray[np.uint8]:
    """Show low..high as 0..255; works in place on ``values``."""
    np.clip(values, stretch.low, stretch.high, out=values)
    values -= stretch.low
    values *= 255 / (stretch.high - stretch.low)
    return np.rint(values, out=values).astype(np.uint8)
