"""A copy of an image as a GeoTIFF in local metres: programs of maps measure in it by the estimated scale.

Where on Earth it lies nobody knows. The copy's system is a plane of its own, the upper left corner at 0, 0, x to the
right and y upwards.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from vehanchor.errors import MissingExtraError, OutputError
from vehanchor.imagery.raster import Window
from vehanchor.storage.atomic import whole_file

if TYPE_CHECKING:
    from vehanchor.imagery.raster import Raster

_SUFFIXES = (".tif", ".tiff")
_LOCAL_METRES = 'LOCAL_CS["VehAnchor, local metres",UNIT["metre",1]]'
_TILE_PX = 512


def check_copy_path(path: str | Path) -> Path:
    """Make sure that a copy can be written there, before the work.

    Raises:
        OutputError: the suffix is another, or the folder does not exist.
        MissingExtraError: rasterio is not installed.
    """
    target = Path(path)
    if target.suffix.lower() not in _SUFFIXES:
        raise OutputError(f"cannot write a GeoTIFF as {str(path)!r}: use .tif or .tiff")
    if not target.parent.is_dir() or target.is_dir():
        raise OutputError(f"cannot write {str(path)!r}: name a file in a folder that exists")
    _import_rasterio()
    return target


def write_metric_copy(path: str | Path, raster: Raster, gsd_m_per_px: float) -> Path:
    """Write an image in full size, 8-bit RGB and upright, with the size of its pixels.

    Args:
        path: ``.tif`` or ``.tiff``.
        raster: the image; it is read by rows of tiles, so that its size does not matter.
        gsd_m_per_px: the side of a pixel, metres.

    Returns:
        The path.

    Raises:
        OutputError: see ``check_copy_path``; or the file system refuses.
        MissingExtraError: rasterio is not installed.
        ImageError: the image cannot be read.
    """
    target, rasterio = check_copy_path(path), _import_rasterio()
    width, height = raster.width_px, raster.height_px
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "width": width,
        "height": height,
        "count": 3,
        "dtype": "uint8",
        "photometric": "RGB",
        "interleave": "pixel",
        "compress": "deflate",
        "predictor": 2,
        "tiled": True,
        "blockxsize": _TILE_PX,
        "blockysize": _TILE_PX,
        "BIGTIFF": "IF_SAFER",
        "crs": rasterio.CRS.from_wkt(_LOCAL_METRES),
        "transform": rasterio.Affine(gsd_m_per_px, 0, 0, 0, -gsd_m_per_px, 0),
    }
    with whole_file(target) as partial:
        try:
            with rasterio.open(partial, "w", **profile) as copy:
                for top in range(0, height, _TILE_PX):
                    rows = min(_TILE_PX, height - top)
                    pixels = raster.read(Window(0, top, width, rows))
                    copy.write(pixels.transpose(2, 0, 1), window=((top, top + rows), (0, width)))
        except rasterio.errors.RasterioError as error:
            raise OutputError(f"cannot write {str(path)!r}: {error}") from error
    return target


def _import_rasterio() -> Any:
    try:
        import rasterio
        import rasterio.errors
    except ImportError as error:
        raise MissingExtraError("a GeoTIFF is written by rasterio: pip install 'vehanchor[geo]'") from error
    return rasterio
