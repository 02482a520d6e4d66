"""Images read by windows through rasterio: GeoTIFF, COG, JPEG 2000, and datasets that the caller has opened."""

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
from vehanchor.imagery.bands import check_dtype, choose_bands, merge_bands
from vehanchor.imagery.limits import check_block, check_windowed_size
from vehanchor.imagery.metadata.georeference import Ground, dataset_gsd_m_per_px
from vehanchor.imagery.raster import Raster, StoredPixels, Window, stored_window
from vehanchor.imagery.stretch import SAMPLE_PX

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from vehanchor.imagery.bands import BandChoice
    from vehanchor.imagery.formats.header import ImageHeader
    from vehanchor.options import ImageLimits

_CACHE_BYTES = 192 << 20  # of decoded blocks, of all files together: what two rows of tiles share of a wide image
_SAMPLE_GRID = 8  # windows a side: 64 spots of 128 px make SAMPLE_PX
_SHOWN_PHOTOMETRIC = (1, 2, 3, 6)  # grey from black, RGB, palette, YCbCr
_DRIVERS = {"TIFF": "GTiff", "JPEG 2000": "JP2OpenJPEG", "JPEG": "JPEG"}
_OPENJPEG_SAMPLE_BYTES = 4
_INKS = frozenset({"cyan", "magenta", "yellow", "black"})


class Dataset(Protocol):
    """An image that rasterio has opened for reading: what ``rasterio.open`` gives, and a ``WarpedVRT``."""

    @property
    def width(self) -> int:
        """Columns."""

    @property
    def height(self) -> int:
        """Rows."""

    @property
    def dtypes(self) -> Any:
        """Of each band."""

    def read_masks(self, indexes: Any = None, /, *, window: Any = None) -> NDArray[Any]:
        """255 where a band holds data."""


def is_dataset(image: object) -> TypeGuard[Dataset]:
    """Whether something was opened by rasterio; does not import it."""
    rasterio_base = sys.modules.get("rasterio._base")  # the one base of all its datasets has no public name
    return rasterio_base is not None and isinstance(image, rasterio_base.DatasetBase)


def open_dataset(dataset: Any, bands: BandChoice, limits: ImageLimits) -> DatasetRaster:
    """Read a dataset that the caller has opened, and will close.

    Its pixels are shown as GDAL gives them: an orientation tag is not looked at.

    Raises:
        InvalidParameterError: it is closed or open for writing only, or has no such bands.
        ImageTooLargeError: too many pixels in all, or in one block.
        ImageFormatError: it cannot be measured.
    """
    if dataset.closed or dataset.mode not in ("r", "r+"):
        state = "closed" if dataset.closed else f"open in mode {dataset.mode!r}"
        raise InvalidParameterError(f"the rasterio dataset {dataset.name!r} is {state}: open it for reading")
    check_windowed_size("dataset", dataset.width, dataset.height, limits)
    _check_block(dataset, "dataset", limits)
    inks = _INKS.intersection(each.name for each in dataset.colorinterp)
    if inks:
        raise ImageFormatError(f"the dataset's bands are {', '.join(sorted(inks))}: convert it to RGB")
    return DatasetRaster(dataset, "dataset", bands)


def open_file(
    file: str | bytes, source: str, header: ImageHeader, bands: BandChoice, limits: ImageLimits
) -> DatasetRaster:
    """Open a TIFF or JPEG 2000, by absolute path or in memory; nothing beside it is looked at.

    Args:
        file: its path or its bytes.
        source: what to call it.
        header: what it says of itself.
        bands: which bands are red, green and blue.
        limits: what to refuse.

    Raises:
        MissingExtraError: rasterio is not installed.
        InvalidParameterError: ``bands`` names one that is not there.
        ImageDecodeError: it is damaged.
        ImageTooLargeError: it is stored in blocks of too many pixels.
        ImageFormatError: it cannot be measured.
    """
    layout = header.tiff
    if layout is not None and layout.photometric not in _SHOWN_PHOTOMETRIC:
        raise ImageFormatError(
            f"the TIFF ({source}) has photometric interpretation {layout.photometric}, which is neither"
            " grey (black is zero), RGB, palette nor YCbCr; convert it to RGB"
        )
    check_block("JPEG 2000", header.tile_px, header.bands, _OPENJPEG_SAMPLE_BYTES, limits)
    with ExitStack() as stack:
        dataset = dataset_of(file, source, header, limits, stack)
        with gdal(source):
            if layout is not None:
                check_block("TIFF's mask", layout.mask_block_px, 1, 1, limits)
            # A geotransform speaks of the stored frame: such files are shown as stored.
            orientation = 1 if layout is not None and layout.georeferenced else header.orientation
            raster = DatasetRaster(dataset, source, bands, orientation=orientation)
        raster.closes(stack.pop_all())
    return raster


def dataset_of(file: str | bytes, source: str, header: ImageHeader, limits: ImageLimits, stack: ExitStack) -> Any:
    """Open a file by the one driver of its format, without a look at what lies beside it.

    Args:
        file: its path or its bytes.
        source: what to call it.
        header: what it says of itself.
        limits: of its blocks.
        stack: closes it.

    Returns:
        The dataset of rasterio.

    Raises:
        MissingExtraError: rasterio is not installed.
        ImageDecodeError: it is damaged.
        ImageTooLargeError: it is stored in blocks of too many pixels.
    """
    rasterio = _import_rasterio(source, header)
    # Sidecar files (.aux.xml, .ovr, .msk, .tfw) could change what the file says, a VRT could name any other file.
    with (
        gdal(source, GDAL_DISABLE_READDIR_ON_OPEN="EMPTY_DIR", GDAL_PAM_ENABLED="NO"),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        if isinstance(file, bytes):
            file = stack.enter_context(rasterio.MemoryFile(file)).name
        driver = _DRIVERS[header.format]
        where = {} if driver == "JPEG" else {"GEOREF_SOURCES": "INTERNAL"}
        dataset = stack.enter_context(rasterio.open(file, driver=driver, sharing=False, **where))
        if (dataset.width, dataset.height) != (header.width_px, header.height_px):
            raise ImageDecodeError(f"the {header.format} ({source}) declares two different sizes: damaged")
        _check_block(dataset, header.format, limits)
    return dataset


def _import_rasterio(source: str, header: ImageHeader) -> Any:
    try:
        import rasterio
        import rasterio.enums
        import rasterio.errors
    except ImportError as error:
        why = "georeferenced, too large or of too many bands for OpenCV" if header.tiff else "too large to decode whole"
        if header.format == "JPEG 2000":
            why = "of a format that OpenCV does not decode safely"
        raise MissingExtraError(
            f"the {header.format} ({source}) is {why}; reading it needs rasterio: pip install 'vehanchor[geo]'"
        ) from error
    return rasterio


@contextmanager
def gdal(source: str, **options: str) -> Iterator[None]:
    """Run GDAL with these options, silent on stderr, its errors as ours."""
    from rasterio import Env
    from rasterio._err import CPLE_BaseError, CPLE_OutOfMemoryError
    from rasterio.errors import RasterioError

    try:
        with Env(GDAL_CACHEMAX=_CACHE_BYTES, **options):
            yield
    except VehAnchorError:
        raise
    except (MemoryError, CPLE_OutOfMemoryError) as error:
        raise OutOfMemoryError(f"no memory for the image ({source}): try again later") from error
    # RasterioIOError of rasterio 1.3 is only an OSError, CRSError a ValueError; a damaged palette is a LookupError.
    except (RasterioError, CPLE_BaseError, OSError, ValueError, LookupError, ArithmeticError) as error:
        cause = error.__cause__ or error
        raise ImageDecodeError(f"the image ({source}) cannot be decoded by GDAL: {cause}") from error


def _check_block(dataset: Any, name: str, limits: ImageLimits) -> None:
    together = dataset.count if dataset.profile.get("interleave") == "pixel" else 1
    sample_bytes = max(_dtype(name).itemsize for name in dataset.dtypes)
    check_block(name, max(height * width for height, width in dataset.block_shapes), together, sample_bytes, limits)


def _dtype(name: str) -> np.dtype[Any]:
    try:
        return np.dtype(name)
    except TypeError:  # complex_int16, which only GDAL has
        raise ImageFormatError(
            f"pixels of {name} cannot be measured; convert them to uint8, uint16 or float32"
        ) from None


class DatasetRaster(Raster):
    """An image read through rasterio.

    Args:
        dataset: open for reading; closed with the raster only where ``closes`` says so.
        source: what to call it.
        bands: which bands are red, green and blue.
        orientation: how the stored image is to be turned, as EXIF counts.

    Raises:
        InvalidParameterError: ``bands`` names one that is not there.
        ImageDecodeError: it is damaged.
        ImageFormatError: it cannot be measured.
    """

    def __init__(self, dataset: Any, source: str, bands: BandChoice, *, orientation: int = 1) -> None:
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
        flags = [{flag.name for flag in dataset.mask_flag_enums[index - 1]} for index in self._unique]
        self._masked = any("all_valid" not in names for names in flags)
        self._stack = ExitStack()
        if dtype != np.uint8 and self._palette is None:
            self._choose_stretch(self._sample())

    def closes(self, stack: ExitStack) -> None:
        """Hand over what is to be closed with the raster."""
        self._stack = stack

    def close(self) -> None:
        """Close the file, if it is ours."""
        self._stack.close()

    def read_overview(self, window: Window, factor: int) -> NDArray[np.uint8] | None:
        """Read a window of the image reduced by a factor from the file's overviews; None where it has none for it.

        Args:
            window: as in ``Raster.read_overview``.
            factor: as there.
        """
        step = next((each for each in (factor, factor // 2) if each > 1 and self._has_overview(each)), None)
        if self._palette is not None or step is None:
            return None
        full = Window(*(factor * each for each in (window.x_px, window.y_px, window.width_px, window.height_px)))
        stored = stored_window(full, self.width_px, self.height_px, self._orientation)
        seen = self._shown(self._read_stored(stored, (stored.height_px // step, stored.width_px // step)))
        if step != factor:
            size = window.width_px, window.height_px
            seen = np.asarray(cv2.resize(seen, size, interpolation=cv2.INTER_AREA), np.uint8)
        return seen

    def _has_overview(self, factor: int) -> bool:
        """Whether every band has an overview reduced by this factor."""
        with gdal(self.source):
            return all(factor in self._dataset.overviews(k) for k in self._unique)

    def _read_stored(self, window: Window, shape: tuple[int, int] | None = None) -> StoredPixels:
        bounds = (
            (window.y_px, window.y_px + window.height_px),
            (window.x_px, window.x_px + window.width_px),
        )
        more: dict[str, Any] = {} if shape is None else {"out_shape": (len(self._unique), *shape)}
        with gdal(self.source):
            planes = dict(zip(self._unique, self._dataset.read(self._unique, window=bounds, **more), strict=True))
            masks = self._dataset.read_masks(self._unique, window=bounds, **more) if self._masked else None
        # With "nodata = 0" a band is without data wherever it is dark: only where all are is there no picture.
        valid: NDArray[np.bool_] | None = None if masks is None else masks.any(axis=0)
        if self._palette is not None:
            return StoredPixels(self._palette[planes[1]], valid)
        rgb = merge_bands([planes[index] for index in self._indexes])
        if rgb.dtype.kind == "f":
            finite = np.isfinite(rgb).all(axis=2)
            valid = finite if valid is None else valid & finite
            rgb[~valid] = 0
        return StoredPixels(rgb, valid)

    def _sample(self) -> NDArray[Any]:
        """Values ``[n, 3]`` with data: all of a small raster, else a grid of windows, never the whole of a huge one."""
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
    """The colours of a palette image, ``[values, 3]``; None for all other images."""
    if dataset.count != 1 or dataset.colorinterp[0].name != "palette":
        return None
    colours = np.zeros((1 << 16 if dataset.dtypes[0] == "uint16" else 1 << 8, 3), np.uint8)
    for value, (red, green, blue, _) in dataset.colormap(1).items():
        colours[value] = red, green, blue
    return colours
