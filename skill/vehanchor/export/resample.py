"""Copies of photographs at another scale, for models that expect it."""

from __future__ import annotations

import json
import warnings
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import cv2
import numpy as np

from vehanchor.errors import InvalidParameterError, OutputError
from vehanchor.export import MAX_ENLARGEMENT
from vehanchor.imagery.metadata.resized import metadata_of_copy, with_metadata
from vehanchor.imagery.raster import Window, oriented, swaps_sides
from vehanchor.records.advice import advice_for
from vehanchor.storage.atomic import whole_file

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from numpy.typing import NDArray

    from vehanchor.imagery.metadata.georeference import Ground
    from vehanchor.imagery.raster import Raster, RgbImage
    from vehanchor.records import GsdEstimate, ScaleSource
    from vehanchor.scale.lengths import Spread

_JPEG_SUFFIXES = (".jpg", ".jpeg")
_JPEG_QUALITY = 95
# Copies with more bytes in all their bands are written as 8-bit RGB.
_MAX_BAND_BYTES = 1 << 30
# Files whose bands are kept without a georeference, too.
_SUFFIXES_OF_BANDS = (".tif", ".tiff", ".png")
# Files beside the photograph could replace what it holds.
_ISOLATION = {"GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR", "GDAL_PAM_ENABLED": "NO"}


class SourceScale(Protocol):
    """What a copy needs to know of the photograph's scale: a ``MeasurementScale`` has it."""

    @property
    def gsd_m_per_px(self) -> float | None:
        """Metres per pixel; None without a scale."""

    @property
    def spread(self) -> Spread:
        """Uncertainty of its log."""

    @property
    def confidence(self) -> float | None:
        """0..1; None for a number from the caller."""

    @property
    def source(self) -> ScaleSource:
        """Origin of the scale."""

    @property
    def estimate(self) -> GsdEstimate | None:
        """Record of the estimate; None without a search."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Resampled:
    """Copy of a photograph at another scale.

    Attributes:
        pixels: ``[h, w, 3]`` RGB, upright.
        factor: width of the copy over that of the photograph.
        gsd_m_per_px: scale of the copy, metres per pixel.
        scale: the scale of the photograph.
        source: path of the photograph; empty without one.
        ground: position of the copy on the ground; None without a georeference.
        stored_size_px: columns and rows of the photograph, as its file stores them.
        orientation: EXIF orientation of the photograph's file, 1 to 8.
    """

    pixels: RgbImage
    factor: float
    gsd_m_per_px: float
    scale: SourceScale
    source: str = ""
    ground: Ground | None = None
    stored_size_px: tuple[int, int] = (0, 0)
    orientation: int = 1

    @property
    def facts(self) -> dict[str, Any]:
        """Factor, scale of the copy with its interval, and the chance behind it."""
        low, high = self.scale.spread.around(self.gsd_m_per_px)
        height_px, width_px = self.pixels.shape[:2]
        return {
            "source": self.source,
            "width_px": width_px,
            "height_px": height_px,
            "factor": self.factor,
            "gsd_m_per_px": self.gsd_m_per_px,
            "gsd_ci95_low_m_per_px": low,
            "gsd_ci95_high_m_per_px": high,
            "confidence": self.scale.confidence,
            "scale_source": self.scale.source,
            "source_gsd_m_per_px": self.scale.gsd_m_per_px,
        }

    def write(self, folder: str | Path) -> Path:
        """Write the copy, and its facts as JSON beside it.

        A georeferenced photograph becomes a GeoTIFF, with all bands and the type of its values. So
        does a TIFF or PNG without a georeference that has more than 8-bit colours (extra ``geo``).
        A JPEG stays one with its position and camera; any other becomes a PNG.

        Args:
            folder: folder of the copy, made if it is missing; the name is that of the photograph.

        Returns:
            Path of the copy.

        Raises:
            OutputError: the file cannot be written, or would replace the photograph.
        """
        source = Path(self.source)
        bands = self._own_bands()
        suffix = ".png"
        if self.ground is not None or bands is not None:
            suffix = ".tif"
        elif source.suffix.lower() in _JPEG_SUFFIXES:
            suffix = source.suffix
        path = Path(folder) / f"{source.stem or 'image'}{suffix}"
        if self.source and path.resolve() == source.resolve():
            raise OutputError(f"{str(path)!r} is the photograph itself: choose another folder")
        make_folder(path.parent)
        with whole_file(path) as partial:
            if suffix == ".tif":
                _write_tiff(partial, bands or _Bands.of_rgb(self.pixels), self.ground)
            else:
                partial.write_bytes(self._encoded(suffix))
        with whole_file(path.with_name(f"{path.name}.json")) as partial:
            partial.write_text(json.dumps(self.facts, indent=1), encoding="utf-8")
        return path

    def _own_bands(self) -> _Bands | None:
        """Resample the bands of the file itself.

        Returns:
            None if it has only red, green, blue and transparency of 8 bits, or is too large; and
            for a file that rasterio does not read here.

        Raises:
            OutputError: the bands cannot be read.
        """
        is_read_here = self.ground is not None or _suffix(self.source) in _SUFFIXES_OF_BANDS
        if not is_read_here or not Path(self.source).is_file() or find_spec("rasterio") is None:
            return None
        import rasterio
        from rasterio.enums import Resampling

        height_px, width_px = self.pixels.shape[:2]
        shape = (height_px, width_px)
        if swaps_sides(self.orientation):
            shape = (width_px, height_px)
        method = Resampling.average if self.factor < 1 else Resampling.cubic
        try:
            with (
                rasterio.Env(**_ISOLATION),
                _without_a_warning(),
                rasterio.open(self.source) as file,
            ):
                has_other_size = (file.width, file.height) != self.stored_size_px
                n_bytes = file.count * width_px * height_px * np.dtype(file.dtypes[0]).itemsize
                if self._is_plain(file) or has_other_size or n_bytes > _MAX_BAND_BYTES:
                    return None
                stored = file.read(out_shape=(file.count, *shape), resampling=method)
                profile: dict[str, Any] = {"nodata": file.nodata}
                if [band.name for band in file.colorinterp[:3]] == ["red", "green", "blue"]:
                    profile["photometric"] = "RGB"
        except rasterio.errors.RasterioError as error:
            raise OutputError(f"cannot read the bands of {self.source!r}: {error}") from error
        upright = oriented(np.moveaxis(stored, 0, -1), self.orientation)
        return _Bands(np.moveaxis(upright, -1, 0), profile)

    def _is_plain(self, file: Any) -> bool:
        """Test whether the pixels hold all bands of an open rasterio dataset.

        Without a georeference, a grey picture is plain, too, and transparency is no band.
        """
        if set(file.dtypes) != {"uint8"}:
            return False
        if self.ground is not None:
            return bool(file.count == 3)
        colours = [band for band in file.colorinterp if band.name != "alpha"]
        return len(colours) in (1, 3)

    def _encoded(self, suffix: str) -> bytes:
        bgr = np.ascontiguousarray(self.pixels[:, :, ::-1])
        if suffix == ".png":
            _, png = cv2.imencode(".png", bgr)
            return png.tobytes()
        _, encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        height_px, width_px = self.pixels.shape[:2]
        segments = metadata_of_copy(
            Path(self.source).read_bytes(),
            width_px,
            height_px,
            across=self.factor,
            down=self.factor,
        )
        return with_metadata(encoded.tobytes(), segments)


def make_folder(folder: Path) -> None:
    """Make a folder for copies.

    Raises:
        OutputError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot make the folder {str(folder)!r}: {error.strerror}") from None


def why_not_resampled(estimate: GsdEstimate) -> str | None:
    """Explain why a photograph cannot be resampled to a scale; None if it can."""
    if estimate.scale is None:
        return "there is no scale"
    if estimate.status != "ok":
        return "the scale is not usable"
    if estimate.scale.plane is not None:
        return (
            f"the camera was tilted by {estimate.scale.plane.tilt_deg:.0f} degrees, and the scale "
            "varies"
        )
    return None


def _refuse_unusable(estimate: GsdEstimate, source: str) -> None:
    """Refuse a photograph without a single usable scale, with what would help."""
    why = why_not_resampled(estimate)
    if why is None:
        return
    advice = advice_for(estimate)
    if advice is not None:
        why += f", {advice.why}: {advice.helps}"
    raise InvalidParameterError(f"{source} cannot be resampled: {why}")


def resample_raster(
    raster: Raster,
    scale: SourceScale,
    gsd_m_per_px: float,
    *,
    max_enlargement: float = MAX_ENLARGEMENT,
    max_pixels: int,
) -> Resampled:
    """Resample an open image: averaged if it shrinks, cubic if it grows.

    Args:
        raster: the image.
        scale: its scale, which must be usable.
        gsd_m_per_px: scale of the copy.
        max_enlargement: largest factor.
        max_pixels: most pixels of the image and of the copy.

    Raises:
        InvalidParameterError: the scale is not usable, or the factor or the copy is too large.
        ImageError: the image cannot be read.
    """
    if scale.estimate is not None:
        _refuse_unusable(scale.estimate, raster.source)
    own_gsd = scale.gsd_m_per_px
    assert own_gsd is not None
    factor = own_gsd / gsd_m_per_px
    if factor > max_enlargement:
        raise InvalidParameterError(
            f"{raster.source} would grow by {factor:.3g}, which adds no detail: the limit is "
            f"{max_enlargement:g}. Allow more with max_enlargement"
        )
    width = max(1, round(raster.width_px * factor))
    height = max(1, round(raster.height_px * factor))
    largest = max(width * height, raster.width_px * raster.height_px)
    if largest > max_pixels:
        raise InvalidParameterError(
            f"{raster.source} or its copy has {largest} pixels, the limit is {max_pixels}: "
            "resample its parts"
        )
    window = Window(0, 0, width_px=raster.width_px, height_px=raster.height_px)
    method = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    pixels = cv2.resize(raster.read(window), (width, height), interpolation=method)
    # The sides are whole pixels, so the true factor differs by rounding.
    true_factor = width / raster.width_px
    return Resampled(
        pixels=np.asarray(pixels, dtype=np.uint8),
        factor=true_factor,
        gsd_m_per_px=own_gsd / true_factor,
        scale=scale,
        source=raster.source,
        ground=_ground_of_copy(raster, width, height),
        stored_size_px=raster.in_file.stored_size_px(),
        orientation=raster.in_file.orientation,
    )


def _ground_of_copy(raster: Raster, width_px: int, height_px: int) -> Ground | None:
    ground = raster.ground
    if ground is None:
        return None
    # The georeference is that of the file's pixels, which may not be square.
    across = raster.grid.width_px / width_px
    down = raster.grid.height_px / height_px
    a, b, c, d, e, f = ground.transform[:6]
    affine = type(ground.transform)
    transform = affine(a * across, b * down, c, d * across, e * down, f)
    return ground._replace(transform=transform)


class _Bands(NamedTuple):
    """Bands of a copy.

    Attributes:
        values: ``[bands, h, w]``.
        profile: fields of a profile of rasterio that describe them.
    """

    values: NDArray[Any]
    profile: Mapping[str, Any]

    @classmethod
    def of_rgb(cls, pixels: RgbImage) -> _Bands:
        """Make bands of pixels ``[h, w, 3]``."""
        return cls(np.moveaxis(pixels, 2, 0), {"photometric": "RGB"})


def _suffix(source: str) -> str:
    return Path(source).suffix.lower()


@contextmanager
def _without_a_warning() -> Iterator[None]:
    """Read and write files without a georeference, which are meant here, without a warning."""
    from rasterio.errors import NotGeoreferencedWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        yield


def _write_tiff(path: Path, bands: _Bands, ground: Ground | None) -> None:
    """Write bands, with a georeference if there is one."""
    import rasterio

    n_bands, height, width = bands.values.shape
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "width": width,
        "height": height,
        "count": n_bands,
        "dtype": bands.values.dtype,
        "compress": "deflate",
        **bands.profile,
    }
    if ground is not None:
        profile["crs"] = ground.crs
        profile["transform"] = ground.transform
    with _without_a_warning(), rasterio.open(path, "w", **profile) as file:
        file.write(bands.values)
