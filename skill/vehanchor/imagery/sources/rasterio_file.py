"""Images that rasterio reads by windows: GeoTIFF, COG, JPEG 2000, and the caller's datasets."""

from __future__ import annotations

import math
import sys
import warnings
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeGuard

import cv2
import numpy as np

from vehanchor.errors import (
    ImageDecodeError,
    ImageFormatError,
    InvalidParameterError,
    OutOfMemoryError,
    VehAnchorError,
)
from vehanchor.imagery.bands import check_dtype, choose_bands, is_alpha, merge_bands
from vehanchor.imagery.file_check import missing_rasterio
from vehanchor.imagery.formats.header import IMAGE_FORMATS
from vehanchor.imagery.limits import check_block, check_windowed_size
from vehanchor.imagery.metadata.georeference import (
    Ground,
    ground_pixel,
    pixel_of_transform,
    shape_of_transform,
)
from vehanchor.imagery.raster import Raster, StoredPixels, Window, stored_window
from vehanchor.imagery.stretch import SAMPLE_PX

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from vehanchor.imagery.bands import BandChoice
    from vehanchor.imagery.formats.image_header import ImageHeader
    from vehanchor.imagery.raster import RgbImage
    from vehanchor.options import ImageLimits

    Bands: TypeAlias = NDArray[Any]
    """``[bands, h, w]`` stored values."""

    IsValid: TypeAlias = NDArray[np.bool_]
    """``[h, w]`` pixels that hold data."""

_CACHE_BYTES = 192 << 20
"""GDAL's cache of decoded blocks, for all files together.

It holds the blocks that two rows of tiles share in a wide image.
"""

_SAMPLE_GRID = 8
"""Windows of a sample per side: 64 windows of 128 x 128 px are ``SAMPLE_PX``."""

_INKS = frozenset({"cyan", "magenta", "yellow", "black"})

Shape: TypeAlias = tuple[int, int]
"""Rows and columns."""


class Dataset(Protocol):
    """Image that rasterio has opened for reading, such as a ``WarpedVRT``."""

    def read_masks(self, indexes: Any = None, /, *, window: Any = None) -> NDArray[Any]:
        """Read masks: 255 where a band holds data."""


def is_dataset(image: object) -> TypeGuard[Dataset]:
    """Test whether an object is a rasterio dataset, without importing rasterio."""
    # The common base class of rasterio's datasets has no public name.
    rasterio_base = sys.modules.get("rasterio._base")
    return rasterio_base is not None and isinstance(image, rasterio_base.DatasetBase)


def open_dataset(dataset: Any, bands: BandChoice, limits: ImageLimits) -> DatasetRaster:
    """Make a raster of the caller's dataset, which the caller closes.

    GDAL's pixels are used as they are; an orientation tag is ignored.

    Raises:
        InvalidParameterError: the dataset is closed or open for writing only, or lacks the bands.
        ImageTooLargeError: the dataset or one of its blocks has too many pixels.
        ImageFormatError: the dataset cannot be measured.
    """
    if dataset.closed or dataset.mode not in ("r", "r+"):
        state = "closed" if dataset.closed else f"open in mode {dataset.mode!r}"
        raise InvalidParameterError(
            f"the rasterio dataset {dataset.name!r} is {state}: open it for reading"
        )
    check_windowed_size("dataset", dataset.width, height_px=dataset.height, limits=limits)
    _check_block(dataset, "dataset", limits)
    inks = _INKS.intersection(_band_roles(dataset))
    if inks:
        raise ImageFormatError(
            f"the dataset's bands are {', '.join(sorted(inks))}: convert it to RGB"
        )
    if _is_inverted(dataset):
        raise ImageFormatError(
            "the dataset is grey, and its white is zero (photometric interpretation 0), so that "
            "its pixels are inverted; convert it to RGB"
        )
    return DatasetRaster(dataset, "dataset", bands)


def open_file(
    file: str | bytes,
    source: str,
    *,
    header: ImageHeader,
    bands: BandChoice,
    limits: ImageLimits,
    valid: IsValid | None = None,
) -> DatasetRaster:
    """Open a TIFF or JPEG 2000; sidecar files are ignored.

    Args:
        file: its absolute path, or its bytes.
        source: name of the image in messages.
        header: its header, which has been checked (``file_check``).
        bands: bands to use as red, green and blue.
        limits: limits to apply to the blocks as GDAL reads them.
        valid: as in ``DatasetRaster``.

    Raises:
        MissingExtraError: rasterio is not installed.
        InvalidParameterError: ``bands`` names a missing band.
        ImageDecodeError: the image is damaged.
        ImageTooLargeError: a block has too many pixels.
        ImageFormatError: the image cannot be measured.
    """
    layout = header.tiff
    rasterio = _import_rasterio(source, header)
    with ExitStack() as stack:
        # Sidecar files (.aux.xml, .ovr, .msk, .tfw) could override the file's content; a VRT could
        # name any other file.
        isolation = {"GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", "GDAL_PAM_ENABLED": "NO"}
        with gdal_environment(source, **isolation), warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            if isinstance(file, bytes):
                memory_file = stack.enter_context(rasterio.MemoryFile(file))
                file = memory_file.name
            driver = IMAGE_FORMATS[header.format].gdal_driver
            opened = rasterio.open(file, driver=driver, sharing=False, GEOREF_SOURCES="INTERNAL")
            dataset = stack.enter_context(opened)
            # The limits were applied to the size in the header.
            size = (dataset.width, dataset.height)
            if size != (header.width_px, header.height_px):
                raise ImageDecodeError(
                    f"the {header.format} ({source}) declares two different sizes: damaged"
                )
            _check_block(dataset, header.format, limits)
        # A geotransform refers to the stored frame, so georeferenced files keep their stored
        # orientation.
        is_georeferenced = layout is not None and layout.georeferenced
        orientation = 1 if is_georeferenced else header.orientation
        with gdal_environment(source):
            raster = DatasetRaster(dataset, source, bands, orientation=orientation, valid=valid)
        raster.closing = stack.pop_all()
    return raster


def _import_rasterio(source: str, header: ImageHeader) -> Any:
    """Import rasterio for a file that OpenCV does not decode.

    Raises:
        MissingExtraError: it is not installed; the message says why this file needs it.
    """
    try:
        import rasterio
        import rasterio.enums
        import rasterio.errors
    except ImportError as error:
        raise missing_rasterio(header, source) from error
    return rasterio


@contextmanager
def gdal_environment(source: str, **options: str) -> Iterator[None]:
    """Run GDAL with these options, silent on stderr, and translate its errors."""
    from rasterio import Env
    from rasterio._err import CPLE_BaseError, CPLE_OutOfMemoryError
    from rasterio.errors import NodataShadowWarning, RasterioError

    try:
        with Env(GDAL_CACHEMAX=_CACHE_BYTES, **options), warnings.catch_warnings():
            # rasterio warns that no-data values hide the alpha band; it is read by itself.
            warnings.simplefilter("ignore", NodataShadowWarning)
            yield
    except VehAnchorError:
        raise
    except (MemoryError, CPLE_OutOfMemoryError) as error:
        raise OutOfMemoryError(
            f"not enough memory for the image ({source}): try again later"
        ) from error
    # RasterioIOError is an OSError and CRSError a ValueError; a damaged palette gives a
    # LookupError.
    except (
        RasterioError,
        CPLE_BaseError,
        OSError,
        ValueError,
        LookupError,
        ArithmeticError,
    ) as error:
        cause = error.__cause__ or error
        raise ImageDecodeError(
            f"the image ({source}) cannot be decoded by GDAL: {cause}"
        ) from error


def _check_block(dataset: Any, name: str, limits: ImageLimits) -> None:
    """Check the size of a dataset's largest block.

    Raises:
        ImageTooLargeError: decoding the block would exceed the limits.
        ImageFormatError: the type of the pixels is unsupported.
    """
    is_interleaved = dataset.profile.get("interleave") == "pixel"
    sample_bytes = max(_dtype(dtype_name).itemsize for dtype_name in dataset.dtypes)
    check_block(
        name,
        _largest_block_px(dataset),
        samples=dataset.count if is_interleaved else 1,
        sample_bytes=sample_bytes,
        limits=limits,
    )


def _largest_block_px(dataset: Any) -> int:
    """Compute the pixels of a dataset's largest block; bands can have blocks of different sizes."""
    sizes: list[int] = [height * width for height, width in dataset.block_shapes]
    return max(sizes)


def _band_roles(dataset: Any) -> list[str]:
    """List GDAL's name of each band's role, such as ``red``, ``alpha`` or ``undefined``."""
    return [role.name for role in dataset.colorinterp]


def _is_inverted(dataset: Any) -> bool:
    """Test whether GDAL reads a grey image inverted, because its white is zero.

    A palette that GDAL makes of such an image has the right colours.
    """
    if _band_roles(dataset) == ["palette"]:
        return False
    while dataset is not None:
        if dataset.tags(ns="IMAGE_STRUCTURE").get("MINISWHITE") == "YES":
            return True
        # A warped view has the pixels of its source, but not the tag.
        dataset = getattr(dataset, "src_dataset", None)
    return False


def _dtype(name: str) -> np.dtype[Any]:
    """Get the type of a band's pixels by its name.

    Raises:
        ImageFormatError: NumPy has no such type.
    """
    try:
        return np.dtype(name)
    except TypeError:  # GDAL's complex_int16
        raise ImageFormatError(
            f"pixels of {name} cannot be measured; convert them to uint8, uint16 or float32"
        ) from None


# Ground control points: least number for an affine map, and how far it may miss one of them, in
# pixels; a choice.
_MIN_CONTROL_POINTS = 3
_MAX_CONTROL_MISS_PX = 2.0
# Step of the sample that shows whether an image of 8 bits is faint, from the sample of others.
_FAINT_STEP = 16


class DatasetRaster(Raster):
    """Image read through rasterio.

    Args:
        dataset: open for reading; ``closing`` closes it with the raster, if it is not the caller's.
        source: name of the image.
        bands: bands to use as red, green and blue.
        orientation: EXIF orientation to apply.
        valid: ``[h, w]``, whether a pixel holds data by a file beside the image; None without one.

    Raises:
        InvalidParameterError: ``bands`` names a missing band.
        ImageDecodeError: the image is damaged.
        ImageFormatError: the image cannot be measured.
    """

    def __init__(
        self,
        dataset: Any,
        source: str,
        bands: BandChoice,
        *,
        orientation: int = 1,
        valid: IsValid | None = None,
    ) -> None:
        self._palette = _read_palette(dataset)
        if self._palette is None:
            channels, notes = choose_bands(dataset.count, bands)
            self._indexes = [channel + 1 for channel in channels]
        else:
            # The one band of a palette image stands for three colours.
            channels, notes = choose_bands(3, bands)
            self._palette = self._palette[:, list(channels)]
            self._indexes = [1, 1, 1]
        super().__init__(
            source,
            dataset.width,
            dataset.height,
            orientation=orientation,
            notes=notes,
        )
        first_index = self._indexes[0]
        dtype = _dtype(dataset.dtypes[first_index - 1])
        check_dtype(dtype)
        self._dataset = dataset
        self._read_place()
        self._unique_indexes = sorted(set(self._indexes))
        self._has_mask = self._find_mask()
        self._valid = valid
        self.closing = ExitStack()
        self._alpha = self._find_alpha()
        if self._palette is None:
            sample = self._sample()
            # A coarser sample shows as well whether an image of 8 bits is faint.
            self._choose_stretch(sample[::_FAINT_STEP] if dtype == np.uint8 else sample)

    def _read_place(self) -> None:
        """Read the place of the image, and the size and shape of a pixel on the ground."""
        dataset = self._dataset
        pixel = ground_pixel(dataset)
        if pixel is not None:
            self.georeference(pixel, Ground(dataset.transform, dataset.crs))
            return
        size = {"width_px": dataset.width, "height_px": dataset.height}
        self.ground = _ground_of_control_points(dataset)
        if self.ground is None:
            # Without a reference system, a transform still gives the shape.
            shape = shape_of_transform(dataset.transform, **size)
        else:
            shape = pixel_of_transform(*self.ground, **size)
        if shape is not None:
            self.take_shape(shape)

    def close(self) -> None:
        """Close the file unless it is the caller's dataset."""
        self.closing.close()

    def read_overview(self, window: Window, factor: int) -> RgbImage | None:
        """Read a window of the reduced image from the file's overviews; None if none fits."""
        overview_factor = self._overview_factor(factor)
        # Overviews of a palette image can hold means of indexes, which are not colours.
        if self._palette is not None or overview_factor is None:
            return None
        full = Window(
            factor * window.x_px,
            factor * window.y_px,
            width_px=factor * window.width_px,
            height_px=factor * window.height_px,
        )
        window_in_file = stored_window(
            full,
            self.width_px,
            height_px=self.height_px,
            orientation=self._orientation,
        )
        rows = window_in_file.height_px // overview_factor
        columns = window_in_file.width_px // overview_factor
        stored = self._read_stored(window_in_file, (rows, columns))
        overview = self._to_rgb(stored)
        if overview_factor == factor:
            return overview
        size = (window.width_px, window.height_px)
        reduced = cv2.resize(overview, size, interpolation=cv2.INTER_AREA)
        return np.asarray(reduced, np.uint8)

    def _overview_factor(self, factor: int) -> int | None:
        """Choose the overview to read: of this factor, or of half of it; None if there is none."""
        with gdal_environment(self.source):
            overviews = [self._dataset.overviews(index) for index in self._unique_indexes]
        available = set.intersection(*map(set, overviews))
        for candidate in (factor, factor // 2):
            if candidate > 1 and candidate in available:
                return candidate
        return None

    def _read_stored(self, window: Window, shape: Shape | None = None) -> StoredPixels:
        """Read a window of the stored frame, reduced to ``shape`` if it is given."""
        indexes = self._unique_indexes
        with gdal_environment(self.source):
            bands = self._read_bands(indexes, window, shape)
            valid = self._read_valid(window, shape)
        band_of_index = dict(zip(indexes, bands, strict=True))
        if self._palette is not None:
            values = band_of_index[1]
            return StoredPixels(self._palette[values], valid)
        rgb = merge_bands([band_of_index[index] for index in self._indexes])
        if rgb.dtype.kind == "f":
            finite = np.isfinite(rgb).all(axis=2)
            valid = _both(valid, finite)
            rgb[~valid] = 0
        return StoredPixels(rgb, valid)

    def _read_valid(self, window: Window, shape: Shape | None) -> IsValid | None:
        """Read which pixels hold data by mask, no-data value and alpha; None if all do."""
        valid: IsValid | None = None
        if self._has_mask:
            indexes = self._unique_indexes
            options = _reading_options(window, shape, n_bands=len(indexes))
            masks = self._dataset.read_masks(indexes, **options)
            # With "nodata = 0" a dark band counts as empty; a pixel has no data only if all bands
            # are empty.
            valid = masks.any(axis=0)
        if self._valid is not None:
            valid = _both(valid, self._valid_part(window, shape))
        if self._alpha is not None:
            (alpha,) = self._read_bands([self._alpha], window, shape)
            valid = _both(valid, alpha != 0)
        return valid

    def _valid_part(self, window: Window, shape: Shape | None) -> IsValid:
        """Cut a window out of the mask beside the file, reduced to ``shape`` if it is given."""
        assert self._valid is not None
        rows = slice(window.y_px, window.y_px + window.height_px)
        columns = slice(window.x_px, window.x_px + window.width_px)
        part = self._valid[rows, columns]
        if shape is None:
            return part
        size = (shape[1], shape[0])
        reduced = cv2.resize(part.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        return np.asarray(reduced, np.bool_)

    def _read_bands(self, indexes: list[int], window: Window, shape: Shape | None) -> Bands:
        """Read bands of a window, ``[bands, h, w]``."""
        options = _reading_options(window, shape, n_bands=len(indexes))
        bands: Bands = self._dataset.read(indexes, **options)
        return bands

    def _find_mask(self) -> bool:
        """Test whether a band that is read has a mask, a no-data value or an alpha band."""
        with gdal_environment(self.source):
            flags_of_bands = self._dataset.mask_flag_enums
        for index in self._unique_indexes:
            flag_names = {flag.name for flag in flags_of_bands[index - 1]}
            if "all_valid" not in flag_names:
                return True
        return False

    def _find_alpha(self) -> int | None:
        """Find the alpha band that is not read as a colour; None without one.

        A band of undeclared role is alpha if it is the last of two or four and has no other values
        than alpha has.
        """
        roles = _band_roles(self._dataset)
        if "alpha" in roles:
            declared = roles.index("alpha") + 1
            return None if declared in self._indexes else declared
        last = len(roles)
        can_be_alpha = last in (2, 4) and roles[-1] == "undefined"
        if not can_be_alpha or last in self._indexes:
            return None
        samples = []
        with gdal_environment(self.source):
            for window, shape in self._sample_windows():
                (band,) = self._read_bands([last], window, shape)
                samples.append(band.ravel())
        return last if is_alpha(np.concatenate(samples)) else None

    def _sample(self) -> NDArray[Any]:
        """Sample valid values ``[n, 3]``."""
        samples = []
        for window, shape in self._sample_windows():
            rgb, valid = self._read_stored(window, shape)
            if valid is None:
                samples.append(rgb.reshape(-1, 3))
            else:
                samples.append(rgb[valid])
        return np.concatenate(samples)

    def _sample_windows(self) -> list[tuple[Window, Shape | None]]:
        """Lay out the windows of a sample of about ``SAMPLE_PX`` pixels.

        Returns:
            Windows, each with the shape to which it is reduced; None for its own shape.
        """
        width = self._dataset.width
        height = self._dataset.height
        whole = Window(0, 0, width_px=width, height_px=height)
        if width * height <= SAMPLE_PX:
            return [(whole, None)]
        # A raster of large blocks is read once, so that no block is decoded again for each window.
        if _largest_block_px(self._dataset) > SAMPLE_PX:
            excess = width * height / SAMPLE_PX
            step = math.ceil(math.sqrt(excess))
            rows = max(1, height // step)
            columns = max(1, width // step)
            return [(whole, (rows, columns))]
        # Otherwise a grid of windows, from border to border, costs only the blocks that it meets.
        side = math.isqrt(SAMPLE_PX) // _SAMPLE_GRID
        window_width = min(side, width)
        window_height = min(side, height)
        windows: list[tuple[Window, Shape | None]] = []
        positions = np.linspace(0, 1, _SAMPLE_GRID)
        for row_position in positions:
            y = int(row_position * (height - window_height))
            for column_position in positions:
                x = int(column_position * (width - window_width))
                window = Window(x, y, width_px=window_width, height_px=window_height)
                windows.append((window, None))
        return windows


def _ground_of_control_points(dataset: Any) -> Ground | None:
    """Fit map coordinates to ground control points; None without points that an affine map fits.

    They give coordinates to results and the shape of a pixel, and no scale: photographs with such
    points are not maps.
    """
    from rasterio.transform import from_gcps

    points, crs = dataset.gcps
    if len(points) < _MIN_CONTROL_POINTS or crs is None:
        return None
    try:
        transform = from_gcps(points)
    except Exception:
        return None
    a, b, c, d, e, f = tuple(~transform)[:6]
    misses_px = []
    for point in points:
        column = a * point.x + b * point.y + c
        row = d * point.x + e * point.y + f
        misses_px.append(math.hypot(column - point.col, row - point.row))
    return Ground(transform, crs) if max(misses_px) <= _MAX_CONTROL_MISS_PX else None


def _reading_options(window: Window, shape: Shape | None, n_bands: int) -> dict[str, Any]:
    """Make rasterio's keyword arguments for reading a window, reduced to ``shape`` if given."""
    rows = (window.y_px, window.y_px + window.height_px)
    columns = (window.x_px, window.x_px + window.width_px)
    options: dict[str, Any] = {"window": (rows, columns)}
    if shape is not None:
        options["out_shape"] = (n_bands, *shape)
    return options


def _both(valid: IsValid | None, other_valid: IsValid) -> IsValid:
    """Combine two masks of valid pixels; None is a mask in which all pixels are valid."""
    if valid is None:
        return other_valid
    return valid & other_valid


def _read_palette(dataset: Any) -> NDArray[np.uint8] | None:
    """Read the colours of a palette image, ``[values, 3]``; None for other images."""
    if _band_roles(dataset) != ["palette"]:
        return None
    n_bits = 16 if dataset.dtypes[0] == "uint16" else 8
    palette = np.zeros((1 << n_bits, 3), np.uint8)
    for value, rgba in dataset.colormap(1).items():
        palette[value] = rgba[:3]
    return palette
