"""Images read by windows through rasterio: GeoTIFF, COG, JPEG 2000, and the caller's open datasets."""

from __future__ import annotations

import math
import sys
import warnings
from contextlib import ExitStack, contextmanager
from typing import TYPE_CHECKING, Any, Protocol, TypeGuard

import cv2
import numpy as np

from vehanchor.errors import (
    ImageDecodeError,
    ImageFormatError,
    InvalidParameterError,
    MissingExtraError,
    OutOfMemoryError,
    VehAnchorError,
)
from vehanchor.imagery.bands import check_dtype, choose_bands, is_alpha, merge_bands
from vehanchor.imagery.limits import check_block, check_windowed_size
from vehanchor.imagery.metadata.georeference import Ground, dataset_gsd_m_per_px
from vehanchor.imagery.raster import Raster, StoredPixels, Window, stored_window
from vehanchor.imagery.stretch import SAMPLE_PX

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from vehanchor.imagery.bands import BandChoice
    from vehanchor.imagery.formats.image_header import ImageHeader
    from vehanchor.options import ImageLimits

# of decoded blocks of all files: the overlap of two rows of tiles in a wide image
_CACHE_BYTES = 192 << 20
_SAMPLE_GRID = 8  # windows per side: 64 windows of 128 px make SAMPLE_PX
_SUPPORTED_PHOTOMETRIC = (1, 2, 3, 6)  # grey from black, RGB, palette, YCbCr
_DRIVERS = {"TIFF": "GTiff", "JPEG 2000": "JP2OpenJPEG"}
_OPENJPEG_SAMPLE_BYTES = 4
_INKS = frozenset({"cyan", "magenta", "yellow", "black"})


class Dataset(Protocol):
    """Image that rasterio has opened for reading: the result of ``rasterio.open``, or a ``WarpedVRT``."""

    def read_masks(self, indexes: Any = None, /, *, window: Any = None) -> NDArray[Any]:
        """Read masks: 255 where a band holds data."""


def is_dataset(image: object) -> TypeGuard[Dataset]:
    """Test whether an object is a rasterio dataset, without importing rasterio."""
    # the common base of its datasets has no public name
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
    inks = _INKS.intersection(each.name for each in dataset.colorinterp)
    if inks:
        raise ImageFormatError(
            f"the dataset's bands are {', '.join(sorted(inks))}: convert it to RGB"
        )
    return DatasetRaster(dataset, "dataset", bands)


def open_file(
    file: str | bytes, source: str, header: ImageHeader, bands: BandChoice, limits: ImageLimits
) -> DatasetRaster:
    """Open a TIFF or JPEG 2000 by absolute path or from memory; sidecar files are ignored.

    Args:
        file: its path or its bytes.
        source: name of the image in messages.
        header: its header.
        bands: bands to use as red, green and blue.
        limits: limits to apply.

    Raises:
        MissingExtraError: rasterio is not installed.
        InvalidParameterError: ``bands`` names a missing band.
        ImageDecodeError: the image is damaged.
        ImageTooLargeError: a block has too many pixels.
        ImageFormatError: the image cannot be measured.
    """
    layout = header.tiff
    if layout is not None and layout.photometric not in _SUPPORTED_PHOTOMETRIC:
        raise ImageFormatError(
            f"the TIFF ({source}) has photometric interpretation {layout.photometric}, which is "
            "neither"
            " grey (black is zero), RGB, palette nor YCbCr; convert it to RGB"
        )
    check_block(
        "JPEG 2000",
        header.tile_px,
        samples=header.bands,
        sample_bytes=_OPENJPEG_SAMPLE_BYTES,
        limits=limits,
    )
    rasterio = _import_rasterio(source, header)
    # Sidecar files (.aux.xml, .ovr, .msk, .tfw) could override the file's content; a VRT could name
    # any other file.
    own = {"GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", "GDAL_PAM_ENABLED": "NO"}
    with ExitStack() as stack:
        with gdal_environment(source, **own), warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            if isinstance(file, bytes):
                file = stack.enter_context(rasterio.MemoryFile(file)).name
            dataset = stack.enter_context(
                rasterio.open(
                    file, driver=_DRIVERS[header.format], sharing=False, GEOREF_SOURCES="INTERNAL"
                )
            )
            if (dataset.width, dataset.height) != (header.width_px, header.height_px):
                raise ImageDecodeError(
                    f"the {header.format} ({source}) declares two different sizes: damaged"
                )
            _check_block(dataset, header.format, limits)
        if layout is not None:
            check_block(
                "TIFF's mask", layout.mask_block_px, samples=1, sample_bytes=1, limits=limits
            )
        # A geotransform refers to the stored frame, so georeferenced files keep their stored
        # orientation.
        orientation = 1 if layout is not None and layout.georeferenced else header.orientation
        with gdal_environment(source):
            raster = DatasetRaster(dataset, source, bands, orientation=orientation)
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
        unsafe = "has a format that OpenCV does not decode safely"
        why = "is georeferenced, too large or unsupported by OpenCV" if header.tiff else unsafe
        raise MissingExtraError(
            f"the {header.format} ({source}) {why}; reading it needs rasterio: pip install "
            "'vehanchor[geo]'"
        ) from error
    return rasterio


@contextmanager
def gdal_environment(source: str, **options: str) -> Iterator[None]:
    """Run GDAL with these options, silent on stderr, and translate its errors."""
    from rasterio import Env
    from rasterio._err import CPLE_BaseError, CPLE_OutOfMemoryError
    from rasterio.errors import NodataShadowWarning, RasterioError

    try:
        with Env(GDAL_CACHEMAX=_CACHE_BYTES, **options), warnings.catch_warnings():
            warnings.simplefilter("ignore", NodataShadowWarning)  # the alpha band is read by itself
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
    together = dataset.count if dataset.profile.get("interleave") == "pixel" else 1
    sample_bytes = max(_dtype(name).itemsize for name in dataset.dtypes)
    check_block(
        name,
        max(height * width for height, width in dataset.block_shapes),
        samples=together,
        sample_bytes=sample_bytes,
        limits=limits,
    )


def _dtype(name: str) -> np.dtype[Any]:
    try:
        return np.dtype(name)
    except TypeError:  # complex_int16 exists only in GDAL
        raise ImageFormatError(
            f"pixels of {name} cannot be measured; convert them to uint8, uint16 or float32"
        ) from None


class DatasetRaster(Raster):
    """Image read through rasterio.

    Args:
        dataset: open for reading; ``closing`` closes it with the raster, if it is not the caller's.
        source: name of the image.
        bands: bands to use as red, green and blue.
        orientation: EXIF orientation to apply.

    Raises:
        InvalidParameterError: ``bands`` names a missing band.
        ImageDecodeError: the image is damaged.
        ImageFormatError: the image cannot be measured.
    """

    def __init__(
        self, dataset: Any, source: str, bands: BandChoice, *, orientation: int = 1
    ) -> None:
        self._palette = _palette(dataset)
        if self._palette is not None:
            channels, notes = choose_bands(3, bands)
            self._palette = self._palette[:, list(channels)]
            self._indexes = [1, 1, 1]
        else:
            channels, notes = choose_bands(dataset.count, bands)
            self._indexes = [channel + 1 for channel in channels]
        super().__init__(
            source,
            dataset.width,
            dataset.height,
            orientation=orientation,
            georeference_gsd_m_per_px=dataset_gsd_m_per_px(dataset),
            notes=notes,
        )
        if self.georeference_gsd_m_per_px is not None:
            self.ground = Ground(dataset.transform, dataset.crs)
        dtype = _dtype(dataset.dtypes[self._indexes[0] - 1])
        check_dtype(dtype)
        self._dataset = dataset
        self._unique = sorted(set(self._indexes))
        with gdal_environment(source):
            flags = [
                {flag.name for flag in dataset.mask_flag_enums[index - 1]} for index in self._unique
            ]
        self._masked = any("all_valid" not in names for names in flags)
        self.closing = ExitStack()
        self._alpha = self._alpha_band()
        if dtype != np.uint8 and self._palette is None:
            self._choose_stretch(self._sample())

    def close(self) -> None:
        """Close the file unless it is the caller's dataset."""
        self.closing.close()

    def read_overview(self, window: Window, factor: int) -> NDArray[np.uint8] | None:
        """Read a window of the reduced image from the file's overviews; None if none fits the factor."""
        with gdal_environment(self.source):
            kept = set.intersection(*(set(self._dataset.overviews(k)) for k in self._unique))
        step = next((each for each in (factor, factor // 2) if each > 1 and each in kept), None)
        if self._palette is not None or step is None:
            return None
        full = Window(
            *(
                factor * each
                for each in (window.x_px, window.y_px, window.width_px, window.height_px)
            )
        )
        stored = stored_window(
            full, self.width_px, height_px=self.height_px, orientation=self._orientation
        )
        overview = self._to_rgb(
            self._read_stored(stored, (stored.height_px // step, stored.width_px // step))
        )
        if step != factor:
            size = window.width_px, window.height_px
            overview = np.asarray(
                cv2.resize(overview, size, interpolation=cv2.INTER_AREA), np.uint8
            )
        return overview

    def _read_stored(self, window: Window, shape: tuple[int, int] | None = None) -> StoredPixels:
        bounds = _bounds(window)
        more, of_one = (
            {} if shape is None else {"out_shape": (n, *shape)} for n in (len(self._unique), 1)
        )
        with gdal_environment(self.source):
            planes = dict(
                zip(
                    self._unique,
                    self._dataset.read(self._unique, window=bounds, **more),
                    strict=True,
                )
            )
            masks = (
                self._dataset.read_masks(self._unique, window=bounds, **more)
                if self._masked
                else None
            )
            opaque = (
                None
                if self._alpha is None
                else self._dataset.read([self._alpha], window=bounds, **of_one)[0] != 0
            )
        # With "nodata = 0" a dark band counts as empty; a pixel has no data only if all bands are
        # empty.
        valid: NDArray[np.bool_] | None = None if masks is None else masks.any(axis=0)
        if opaque is not None:
            valid = opaque if valid is None else valid & opaque
        if self._palette is not None:
            return StoredPixels(self._palette[planes[1]], valid)
        rgb = merge_bands([planes[index] for index in self._indexes])
        if rgb.dtype.kind == "f":
            finite = np.isfinite(rgb).all(axis=2)
            valid = finite if valid is None else valid & finite
            rgb[~valid] = 0
        return StoredPixels(rgb, valid)

    def _alpha_band(self) -> int | None:
        """Find the band that is declared to be alpha, or undeclared and without other values than alpha has."""
        kinds = [each.name for each in self._dataset.colorinterp]
        if "alpha" in kinds:
            band = kinds.index("alpha") + 1
            return None if band in self._indexes else band
        last = len(kinds)
        if last not in (2, 4) or kinds[-1] != "undefined" or last in self._indexes:
            return None
        with gdal_environment(self.source):
            parts = [
                self._dataset.read(last, window=_bounds(window), out_shape=shape).ravel()
                for window, shape in self._sample_places()
            ]
        return last if is_alpha(np.concatenate(parts)) else None

    def _sample(self) -> NDArray[Any]:
        """Sample valid values ``[n, 3]``."""
        parts = [self._read_stored(*place) for place in self._sample_places()]
        return np.concatenate(
            [
                part.rgb.reshape(-1, 3) if part.valid is None else part.rgb[part.valid]
                for part in parts
            ]
        )

    def _sample_places(self) -> list[tuple[Window, tuple[int, int] | None]]:
        """Lay out the sample, as windows with the rows and columns to read them at; None for their own.

        All of a small raster, a grid of windows of a large one; a raster of large blocks once, so
        that no block is decoded again for each window.
        """
        width = self._dataset.width
        height = self._dataset.height
        if width * height <= SAMPLE_PX:
            return [(Window(0, 0, width_px=width, height_px=height), None)]
        if max(rows * columns for rows, columns in self._dataset.block_shapes) > SAMPLE_PX:
            step = math.ceil(math.sqrt(width * height / SAMPLE_PX))
            return [
                (
                    Window(0, 0, width_px=width, height_px=height),
                    (max(1, height // step), max(1, width // step)),
                )
            ]
        side = math.isqrt(SAMPLE_PX) // _SAMPLE_GRID
        spots = np.linspace(0, 1, _SAMPLE_GRID)
        w = min(side, width)
        h = min(side, height)
        return [
            (Window(int(x * (width - w)), int(y * (height - h)), width_px=w, height_px=h), None)
            for y in spots
            for x in spots
        ]


def _bounds(window: Window) -> tuple[tuple[int, int], tuple[int, int]]:
    """Rows and columns of a window, as rasterio takes them."""
    return (window.y_px, window.y_px + window.height_px), (
        window.x_px,
        window.x_px + window.width_px,
    )


def _palette(dataset: Any) -> NDArray[np.uint8] | None:
    """Read the colours of a palette image, ``[values, 3]``; None for other images."""
    if dataset.count != 1 or dataset.colorinterp[0].name != "palette":
        return None
    colours = np.zeros((1 << 16 if dataset.dtypes[0] == "uint16" else 1 << 8, 3), np.uint8)
    for value, (red, green, blue, _) in dataset.colormap(1).items():
        colours[value] = red, green, blue
    return colours
