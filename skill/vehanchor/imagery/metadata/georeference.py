"""Pixel of a georeferenced raster on the ground: its ground sampling distance (GSD) and its shape.

Estimates never use the GSD. Records report it next to the estimate, and the evaluation uses it as
ground truth. Measurements use it if nothing contradicts it (``vehanchor.measure.scale_source``).
The shape is a fact without a scale: images are analysed in square pixels.
"""

from __future__ import annotations

import math
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


class GroundPixel(NamedTuple):
    """Pixel of a georeferenced image, as a parallelogram on the ground.

    Attributes:
        across_m: side along a row, metres.
        down_m: side along a column, metres.
        gsd_m_per_px: side of a square of the same area, metres.
    """

    across_m: float
    down_m: float
    gsd_m_per_px: float

    @property
    def aspect(self) -> float:
        """Height over width."""
        return self.down_m / self.across_m

    @property
    def is_upright(self) -> bool:
        """Whether the sides are at right angles, within two degrees."""
        sine = self.gsd_m_per_px**2 / (self.across_m * self.down_m)
        return sine >= _LEAST_SINE

    @property
    def has_sides(self) -> bool:
        """Whether the sides and the area are finite and above 0."""
        return all(math.isfinite(side) and side > 0 for side in self)

    def is_like(self, other: GroundPixel) -> bool:
        """Test whether another pixel has these sides and this area, within one percent."""
        log_ratios = np.abs(np.log(self) - np.log(other))
        return bool(log_ratios.max() <= math.log(_MAX_GRID_SCALE))


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

_LEAST_SINE = math.cos(math.radians(2))
"""Sine of the angle between a pixel's sides from which it counts as a rectangle; a choice."""

_IDENTITY: AffineCoefficients = (1, 0, 0, 0, 1, 0)
"""GDAL's transform of a file without one."""

_MAX_COORDINATE = 1e9
"""Largest coordinate; greater ones are off the Earth in any unit.

PROJ loops for hours on coordinates such as 1e20.
"""

_MAX_DEGREES_PER_PX = 1e-4
"""Longest side of a pixel that can be in degrees, some ten metres. A choice.

In metres it would be a tenth of a millimetre.
"""

_MAX_GRID_SCALE = 1.01
"""Ratio of lengths on the ground and in a projection up to which both count as equal.

UTM and most national grids are within 1.001. A choice.
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


def ground_pixel(dataset: Any) -> GroundPixel | None:
    """Measure the pixel at the centre of an open rasterio dataset; see ``pixel_of_transform``.

    Args:
        dataset: a ``rasterio.DatasetReader``.

    Returns:
        None if the coordinate system or the transform is missing or invalid.
    """
    try:
        crs = dataset.crs
    except ValueError:  # PROJ cannot use the system; CRSError is a ValueError.
        return None
    return pixel_of_transform(
        dataset.transform, crs, width_px=dataset.width, height_px=dataset.height
    )


def pixel_of_transform(
    affine: Any, crs: Any, *, width_px: int, height_px: int
) -> GroundPixel | None:
    """Measure the pixel at the centre of an image.

    In projected systems a side is that of the transform times the linear unit in metres, if this is
    right within one percent, as in UTM and most national grids. Other projections, such as Mercator
    and plate carree, stretch metres, so their pixels are converted to degrees first. In geographic
    systems, a degree of longitude is shorter than one of latitude.

    Args:
        affine: from pixels to coordinates, an ``affine.Affine``.
        crs: a ``rasterio.crs.CRS``, or None.
        width_px: columns.
        height_px: rows.

    Returns:
        None if the coordinate system or the transform is missing or invalid.
    """
    from rasterio.errors import RasterioError

    transform: AffineCoefficients = (affine.a, affine.b, affine.c, affine.d, affine.e, affine.f)
    is_finite = all(map(math.isfinite, transform))
    if not crs or transform == _IDENTITY or not is_finite:
        return None
    try:
        metric = _metric_transform(transform, crs, column=width_px / 2, row=height_px / 2)
    # PROJ cannot use the system; CRSError is a ValueError.
    except (RasterioError, ValueError, ArithmeticError):
        return None
    if metric is None:
        return None
    pixel = metric.pixel
    return pixel if pixel.has_sides else None


def shape_of_transform(affine: Any, *, width_px: int, height_px: int) -> GroundPixel | None:
    """Measure the shape of the pixel at the centre of an image whose reference system is unknown.

    The shape needs no scale. The unit is taken for a degree if a pixel would be far below a
    millimetre otherwise.

    Args:
        affine: from pixels to coordinates, an ``affine.Affine``.
        width_px: columns.
        height_px: rows.

    Returns:
        The pixel in an unknown unit of length; None without a transform.
    """
    transform: AffineCoefficients = (affine.a, affine.b, affine.c, affine.d, affine.e, affine.f)
    if transform == _IDENTITY or not all(map(math.isfinite, transform)):
        return None
    _, _, _, d, e, f = transform
    by_units = _MetricTransform(transform, 1.0, 1.0)
    latitude_deg = d * width_px / 2 + e * height_px / 2 + f
    if by_units.pixel.gsd_m_per_px <= _MAX_DEGREES_PER_PX and abs(latitude_deg) < 90:
        latitude_m, longitude_m = metres_per_degree(latitude_deg)
        by_units = _MetricTransform(transform, longitude_m, latitude_m)
    pixel = by_units.pixel
    return pixel if pixel.has_sides else None


class _MetricTransform(NamedTuple):
    """Transform with the length of its units on the ground.

    Attributes:
        transform: from pixels to coordinates.
        x_m: metres per unit of x.
        y_m: metres per unit of y.
    """

    transform: AffineCoefficients
    x_m: float
    y_m: float

    @property
    def pixel(self) -> GroundPixel:
        """The pixel's sides, metres."""
        a, b, _, d, e, _ = self.transform
        return GroundPixel(
            across_m=math.hypot(a * self.x_m, d * self.y_m),
            down_m=math.hypot(b * self.x_m, e * self.y_m),
            gsd_m_per_px=gsd_units_per_px(self.transform) * math.sqrt(self.x_m * self.y_m),
        )


def _metric_transform(
    transform: AffineCoefficients, crs: Any, column: float, row: float
) -> _MetricTransform | None:
    """Find the length of a transform's units at a pixel; None if the place has none."""
    a, b, c, d, e, f = transform
    x = a * column + b * row + c
    y = d * column + e * row + f
    if max(abs(x), abs(y)) > _MAX_COORDINATE:
        return None
    if crs.is_geographic:
        unit_deg = math.degrees(crs.units_factor[1])
        latitude_deg = y * unit_deg
        if abs(latitude_deg) > 90:
            return None
        latitude_m, longitude_m = metres_per_degree(latitude_deg)
        return _MetricTransform(transform, unit_deg * longitude_m, unit_deg * latitude_m)
    if not crs.is_projected:
        return None
    unit_m = float(crs.linear_units_factor[1])
    by_units = _MetricTransform(transform, unit_m, unit_m)
    if not by_units.pixel.has_sides:
        return None
    # A projection can stretch metres, and in one direction only, as Mercator, plate carree and
    # equal-area maps of the world do.
    by_degrees = _by_degrees(transform, crs, x, y)
    if by_degrees is None or not by_degrees.pixel.has_sides:
        return by_units
    return by_units if by_degrees.pixel.is_like(by_units.pixel) else by_degrees


def _by_degrees(
    transform: AffineCoefficients, crs: Any, x: float, y: float
) -> _MetricTransform | None:
    """Convert a pixel, and its neighbours to the right and below, to degrees.

    Returns:
        Its transform to degrees; None if the projection has no degrees there.
    """
    from rasterio._err import CPLE_BaseError
    from rasterio.errors import RasterioError
    from rasterio.warp import transform as reproject

    a, b, _, d, e, _ = transform
    xs = [x, x + a, x + b]
    ys = [y, y + d, y + e]
    if max(map(abs, (*xs, *ys))) > _MAX_COORDINATE:
        return None
    try:
        longitudes, latitudes = reproject(crs, "EPSG:4326", xs, ys)
    except (CPLE_BaseError, RasterioError, ValueError):  # outside the projection
        return None
    longitude, longitude_right, longitude_below = longitudes
    latitude, latitude_right, latitude_below = latitudes
    if not all(map(math.isfinite, (*longitudes, *latitudes))):
        return None
    in_degrees = (
        _step_deg(longitude, longitude_right),
        _step_deg(longitude, longitude_below),
        0.0,
        latitude_right - latitude,
        latitude_below - latitude,
        0.0,
    )
    latitude_m, longitude_m = metres_per_degree(latitude)
    return _MetricTransform(in_degrees, longitude_m, latitude_m)


def _step_deg(first_deg: float, second_deg: float) -> float:
    """Compute the difference of two longitudes, which jump by a full turn at the 180th meridian."""
    return (second_deg - first_deg + 180) % 360 - 180


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
