"""Copies of photographs at another scale, for models that expect it."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from vehanchor.errors import InvalidParameterError, OutputError
from vehanchor.imagery.metadata.resized import metadata_of_copy, with_metadata
from vehanchor.imagery.raster import Window
from vehanchor.storage.atomic import whole_file

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from vehanchor.imagery.metadata.georeference import Ground
    from vehanchor.imagery.raster import Raster, RgbImage
    from vehanchor.records import GsdEstimate

MAX_ENLARGEMENT = 2.0
"""Largest factor unless the caller allows more: a model sees only interpolated pixels beyond."""

_JPEG_SUFFIXES = (".jpg", ".jpeg")
_JPEG_QUALITY = 95
# Copies with more bytes in all their bands are written as 8-bit RGB.
_MAX_BAND_BYTES = 1 << 30


@dataclass(frozen=True, eq=False, kw_only=True)
class Resampled:
    """Copy of a photograph at another scale.

    Attributes:
        pixels: ``[h, w, 3]`` RGB, upright.
        factor: width of the copy over that of the photograph.
        gsd_m_per_px: scale of the copy, metres per pixel.
        estimate: the estimate of the photograph.
        source: path of the photograph; empty without one.
        ground: position of the copy on the ground; None without a georeference.
    """

    pixels: RgbImage
    factor: float
    gsd_m_per_px: float
    estimate: GsdEstimate
    source: str = ""
    ground: Ground | None = None

    @property
    def facts(self) -> dict[str, Any]:
        """Factor, scale of the copy with its interval, and the chance behind it."""
        low = self.estimate.gsd_ci95_low_m_per_px
        high = self.estimate.gsd_ci95_high_m_per_px
        height_px, width_px = self.pixels.shape[:2]
        return {
            "source": self.source,
            "width_px": width_px,
            "height_px": height_px,
            "factor": self.factor,
            "gsd_m_per_px": self.gsd_m_per_px,
            "gsd_ci95_low_m_per_px": None if low is None else low / self.factor,
            "gsd_ci95_high_m_per_px": None if high is None else high / self.factor,
            "confidence": self.estimate.confidence,
            "source_gsd_m_per_px": self.estimate.gsd_m_per_px,
        }

    def write(self, folder: str | Path) -> Path:
        """Write the copy, and its facts as JSON beside it.

        A georeferenced photograph becomes a GeoTIFF, with all bands and the type of its values; a
        JPEG stays one with its position and camera; any other becomes a PNG.

        Args:
            folder: folder of the copy, which exists; the name is that of the photograph.

        Returns:
            Path of the copy.

        Raises:
            OutputError: the file cannot be written, or would replace the photograph.
        """
        source = Path(self.source)
        suffix = ".png"
        if self.ground is not None:
            suffix = ".tif"
        elif source.suffix.lower() in _JPEG_SUFFIXES:
            suffix = source.suffix
        path = Path(folder) / f"{source.stem or 'image'}{suffix}"
        if self.source and path.resolve() == source.resolve():
            raise OutputError(f"{str(path)!r} is the photograph itself: choose another folder")
        with whole_file(path) as partial:
            if self.ground is not None:
                bands, profile = self._bands()
                _write_geotiff(partial, bands, self.ground, profile)
            else:
                partial.write_bytes(self._encoded(suffix))
        with whole_file(path.with_name(f"{path.name}.json")) as partial:
            partial.write_text(json.dumps(self.facts, indent=1), encoding="utf-8")
        return path

    def _bands(self) -> tuple[NDArray[Any], dict[str, Any]]:
        """Resample the bands of the file itself; the pixels if it has none but red, green, blue.

        Returns:
            ``[bands, h, w]`` and the fields of a profile that describe them.
        """
        import rasterio
        from rasterio.enums import Resampling

        rgb = np.moveaxis(self.pixels, 2, 0)
        plain = {"photometric": "RGB"}
        if not Path(self.source).is_file():
            return rgb, plain
        height_px, width_px = self.pixels.shape[:2]
        method = Resampling.average if self.factor < 1 else Resampling.cubic
        with rasterio.open(self.source) as file:
            is_rgb = file.count == 3 and set(file.dtypes) == {"uint8"}
            # A file that is stored turned has other sides.
            is_upright = round(file.width * self.factor) == width_px
            n_bytes = file.count * width_px * height_px * np.dtype(file.dtypes[0]).itemsize
            if is_rgb or not is_upright or n_bytes > _MAX_BAND_BYTES:
                return rgb, plain
            shape = (file.count, height_px, width_px)
            bands = file.read(out_shape=shape, resampling=method)
            return bands, {"nodata": file.nodata}

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


def resample_raster(
    raster: Raster,
    estimate: GsdEstimate,
    gsd_m_per_px: float,
    *,
    max_enlargement: float = MAX_ENLARGEMENT,
    max_pixels: int,
) -> Resampled:
    """Resample an open image: averaged if it shrinks, cubic if it grows.

    Args:
        raster: the image.
        estimate: its estimate, with a usable scale.
        gsd_m_per_px: scale of the copy.
        max_enlargement: largest factor.
        max_pixels: most pixels of the image and of the copy.

    Raises:
        InvalidParameterError: the scale is not usable, or the factor or the copy is too large.
        ImageError: the image cannot be read.
    """
    why = why_not_resampled(estimate)
    if why is not None or estimate.gsd_m_per_px is None:
        raise InvalidParameterError(
            f"{raster.source} cannot be resampled: {why}. Give a known length or a region"
        )
    factor = estimate.gsd_m_per_px / gsd_m_per_px
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
        gsd_m_per_px=estimate.gsd_m_per_px / true_factor,
        estimate=estimate,
        source=raster.source,
        ground=_ground_of_copy(raster, width, height),
    )


def _ground_of_copy(raster: Raster, width_px: int, height_px: int) -> Ground | None:
    ground = raster.ground
    if ground is None:
        return None
    across = raster.width_px / width_px
    down = raster.height_px / height_px
    a, b, c, d, e, f = ground.transform[:6]
    affine = type(ground.transform)
    transform = affine(a * across, b * down, c, d * across, e * down, f)
    return ground._replace(transform=transform)


def _write_geotiff(
    path: Path, bands: NDArray[Any], ground: Ground, more: Mapping[str, Any]
) -> None:
    """Write bands ``[n, h, w]`` with a georeference."""
    import rasterio

    n_bands, height, width = bands.shape
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "width": width,
        "height": height,
        "count": n_bands,
        "dtype": bands.dtype,
        "compress": "deflate",
        "crs": ground.crs,
        "transform": ground.transform,
        **more,
    }
    with rasterio.open(path, "w", **profile) as file:
        file.write(bands)
