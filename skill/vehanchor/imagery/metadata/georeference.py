"""Ground sampling distance (GSD) of a georeferenced raster.

Estimates never use it. Records report it next to the estimate, and the evaluation uses it as ground
truth.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

AffineCoefficients = tuple[float, float, float, float, float, float]
"""(a, b, c, d, e, f), as in ``affine.Affine``.

x = a*column + b*row + c, and y = d*column + e*row + f.
"""


PIXELS_WKT = (
    'LOCAL_CS["Pixels of the image, y down",LOCAL_DATUM["Image",0],UNIT["pixel",1],'
    'AXIS["x",EAST],AXIS["y",SOUTH]]'
)
"""Reference system of an image without a georeference; readers take its unit for pixels."""


class Ground(NamedTuple):
    """Georeference of an image, in rasterio's types.

    Attributes:
        transform: from pixels to coordinates.
        crs: the coordinate reference system.
    """

    transform: Any
    crs: Any


WGS84_SEMI_MAJOR_AXIS_M = 6_378_137.0  # EPSG:7030
WGS84_FLATTENING = 1 / 298.257223563  # EPSG:7030

_IDENTITY: AffineCoefficients = (1, 0, 0, 0, 1, 0)
"""GDAL's transform of a file without one."""

_MAX_COORDINATE = 1e9
"""Largest coordinate; greater ones are off the Earth in any unit.

PROJ loops for hours on coordinates such as 1e20.
"""

_MERCATOR_WKT = re.compile(r'(?:PROJECTION|METHOD)\["(?:Mercator|Popular Visualisation)')
"""Mercator and Web Mercator (EPSG:3857) in WKT 1 and WKT 2.

Transverse and Oblique Mercator are other methods, with other names.
"""


def metres_per_degree(latitude_deg: float) -> tuple[float, float]:
    """Compute the length of one degree of latitude and of longitude, in metres, on WGS84."""
    # Radii of curvature of the ellipsoid in the meridian and in the prime vertical.
    latitude = math.radians(latitude_deg)
    eccentricity2 = WGS84_FLATTENING * (2 - WGS84_FLATTENING)
    w2 = 1 - eccentricity2 * math.sin(latitude) ** 2
    meridian_radius = WGS84_SEMI_MAJOR_AXIS_M * (1 - eccentricity2) / w2**1.5
    normal_radius = WGS84_SEMI_MAJOR_AXIS_M / math.sqrt(w2)
    parallel_radius = normal_radius * math.cos(latitude)
    return math.radians(meridian_radius), math.radians(parallel_radius)


def gsd_units_per_px(transform: AffineCoefficients) -> float:
    """Compute the side of a square with a pixel's area, sqrt(|det|), in the transform's unit."""
    a, b, _, d, e, _ = transform
    return math.sqrt(abs(a * e - b * d))


def geographic_gsd_m_per_px(transform: AffineCoefficients, latitude_deg: float) -> float:
    """Compute the GSD of a raster in degrees at a latitude.

    It is the geometric mean of a pixel's sides on the ground.
    """
    latitude_m, longitude_m = metres_per_degree(latitude_deg)
    return gsd_units_per_px(transform) * math.sqrt(latitude_m * longitude_m)


def dataset_gsd_m_per_px(dataset: Any) -> float | None:
    """Compute the GSD at the centre of an open rasterio dataset, in metres per pixel.

    In projected systems the GSD is the pixel's side times the linear unit in metres. Mercator
    (EPSG:3857, 3395) stretches metres by 1/cos(latitude), so its pixels are converted to degrees
    first. The grid scale of other projections is ignored; it is within 0.1 % in UTM and most
    national grids. For geographic systems, see :func:`geographic_gsd_m_per_px`.

    Args:
        dataset: a ``rasterio.DatasetReader``.

    Returns:
        None if the coordinate system or the transform is missing or invalid.
    """
    from rasterio.errors import RasterioError

    affine = dataset.transform
    transform: AffineCoefficients = (affine.a, affine.b, affine.c, affine.d, affine.e, affine.f)
    try:
        crs = dataset.crs
        is_finite = all(map(math.isfinite, transform))
        if not crs or transform == _IDENTITY or not is_finite:
            return None
        gsd = _gsd_in_crs(transform, crs, column=dataset.width / 2, row=dataset.height / 2)
    # PROJ cannot use the system; CRSError is a ValueError.
    except (RasterioError, ValueError, ArithmeticError):
        return None
    return gsd if math.isfinite(gsd) and gsd > 0 else None


def _gsd_in_crs(transform: AffineCoefficients, crs: Any, column: float, row: float) -> float:
    """Compute the GSD at a pixel; NaN if the system or the place has none."""
    from rasterio.warp import transform as reproject

    a, b, c, d, e, f = transform
    x = a * column + b * row + c
    y = d * column + e * row + f
    if max(abs(x), abs(y)) > _MAX_COORDINATE:
        return math.nan
    if crs.is_geographic:
        unit_deg = math.degrees(crs.units_factor[1])
        latitude_deg = y * unit_deg
        if abs(latitude_deg) > 90:
            return math.nan
        return unit_deg * geographic_gsd_m_per_px(transform, latitude_deg)
    if not crs.is_projected:
        return math.nan
    # Mercator's scale depends on the latitude, and on the latitude of true scale: the pixel and its
    # neighbours to the right and below are converted to degrees.
    if _MERCATOR_WKT.search(crs.to_wkt()):
        xs = [x, x + a, x + b]
        ys = [y, y + d, y + e]
        longitudes, latitudes = reproject(crs, "EPSG:4326", xs, ys)
        longitude, longitude_right, longitude_below = longitudes
        latitude, latitude_right, latitude_below = latitudes
        transform_in_degrees = (
            longitude_right - longitude,
            longitude_below - longitude,
            0.0,
            latitude_right - latitude,
            latitude_below - latitude,
            0.0,
        )
        return geographic_gsd_m_per_px(transform_in_degrees, latitude)
    return gsd_units_per_px(transform) * float(crs.linear_units_factor[1])


def is_in_pixels(collection: Mapping[str, Any]) -> bool:
    """Test whether a collection of features states that it is in pixels, as written here."""
    crs = collection.get("crs")
    if not isinstance(crs, dict):
        return False
    properties = crs.get("properties")
    return isinstance(properties, dict) and properties.get("name") == PIXELS_WKT


def to_pixels(points: NDArray[np.float64], ground: Ground) -> NDArray[np.float64]:
    """Convert points ``[n, 2]``, longitude and latitude of WGS 84, to pixels of an image.

    Args:
        points: the points.
        ground: position of the image on the ground.
    """
    from rasterio.warp import transform

    longitudes, latitudes = points.T.tolist()
    eastings, northings = transform("EPSG:4326", ground.crs, longitudes, latitudes)
    a, b, c, d, e, f = ground.transform[:6]
    # The inverse of the file's affine transform.
    matrix = np.array([(a, b), (d, e)])
    offsets = np.array([np.subtract(eastings, c), np.subtract(northings, f)])
    return np.linalg.solve(matrix, offsets).T
