"""GeoTIFF copy of an image in local metres, in which GIS programs measure with the estimated scale.

The position on Earth is unknown. The reference system is a local plane with the upper left corner
at 0, 0, x to the right and y upwards.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from vehanchor.errors import MissingExtraError, OutputError, how_to_install
from vehanchor.imagery.raster import Window
from vehanchor.storage.atomic import check_output_path, whole_file

if TYPE_CHECKING:
    from pathlib import Path

    from vehanchor.imagery.raster import Raster

_LOCAL_METRES = 'LOCAL_CS["VehAnchor, local metres",UNIT["metre",1]]'
_TILE_PX = 512


def check_copy_path(path: Path) -> None:
    """Check, before the work, that a copy can be written to a path.

    Raises:
        OutputError: the suffix is not ``.tif`` or ``.tiff``, or the folder does not exist.
        MissingExtraError: rasterio is not installed.
    """
    check_output_path(path, (".tif", ".tiff"), kind="a GeoTIFF")
    if find_spec("rasterio") is None:
        raise MissingExtraError(f"writing a GeoTIFF needs rasterio: {how_to_install('geo')}")


def write_metric_copy(path: Path, raster: Raster, gsd_m_per_px: float) -> None:
    """Write an image in full size, 8-bit RGB and upright, with its pixel size.

    Args:
        path: ``.tif`` or ``.tiff``, checked by ``check_copy_path``.
        raster: the image, read one row of tiles at a time.
        gsd_m_per_px: the side of a pixel, metres.

    Raises:
        OutputError: the file cannot be written.
        ImageError: the image cannot be read.
    """
    import rasterio
    import rasterio.errors

    width = raster.width_px
    height = raster.height_px
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "width": width,
        "height": height,
        "count": 3,
        "dtype": "uint8",
        "photometric": "RGB",
        "compress": "deflate",
        "predictor": 2,
        "tiled": True,
        "blockxsize": _TILE_PX,
        "blockysize": _TILE_PX,
        "BIGTIFF": "IF_SAFER",
        "crs": rasterio.CRS.from_wkt(_LOCAL_METRES),
        "transform": rasterio.Affine.scale(gsd_m_per_px, -gsd_m_per_px),
    }
    with whole_file(path) as partial:
        try:
            with rasterio.open(partial, "w", **profile) as copy:
                for top in range(0, height, _TILE_PX):
                    rows = min(_TILE_PX, height - top)
                    pixels = raster.read(Window(0, top, width_px=width, height_px=rows))
                    bands = pixels.transpose(2, 0, 1)
                    copy.write(bands, window=((top, top + rows), (0, width)))
        except rasterio.errors.RasterioError as error:
            raise OutputError(f"cannot write {str(path)!r}: {error}") from error
