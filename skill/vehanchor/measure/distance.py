"""Distance on the ground between two points or along a path.

Raster + path -> pixels x GSD -> record. The scale comes from the whole image, or from the caller.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from vehanchor.analysis.measurement_analysis import DistanceAnalysis
from vehanchor.errors import PromptError
from vehanchor.measure.beside import BESIDE_PHOTOGRAPH, is_path_beside
from vehanchor.measure.scale_source import find_measurement_scale
from vehanchor.options import ScaleOptions
from vehanchor.options.reading import CoordinateFrame
from vehanchor.records import DistanceMeasurement
from vehanchor.records.measurement import image_points
from vehanchor.records.text import count
from vehanchor.segmentation.prompt import read_numbers

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.imagery.raster import Raster
    from vehanchor.measure.scale_source import MeasurementScale, ScaleInput
    from vehanchor.options.reading import Place

MIN_PATH_PX = 2.0
"""Shortest path, pixels of the full image."""

MAX_PATH_POINTS = 1000
# Standard deviation of a point, in the finest step of the caller's coordinates. It is that of
# lines of known length.
_POINT_SD = 1.0


def read_path(path: Sequence[Place]) -> tuple[Place, ...]:
    """Read and check a path of the caller: points, or a line of shapely.

    Raises:
        PromptError: the path is another geometry, has fewer than two points, or has a point that is
            not two finite numbers.
    """
    try:
        coordinates: Any = getattr(path, "coords", path)
    except NotImplementedError:  # from shapely's polygons and collections
        coordinates = None
    if isinstance(coordinates, str) or not isinstance(coordinates, Iterable):
        raise PromptError(f"the path is {path!r}: give a line, or points as x, y")
    points = []
    for point in coordinates:
        x, y = read_numbers(
            point, (2,), name="a point of the path", expected="x, y, as in [(x1, y1), (x2, y2)]"
        )
        points.append((x, y))
    if not 2 <= len(points) <= MAX_PATH_POINTS:
        n_points = count(len(points), "point")
        raise PromptError(
            f"the path has {n_points}: give two, or up to {MAX_PATH_POINTS} along a line"
        )
    return tuple(points)


def analyse_paths(
    raster: Raster,
    paths: Sequence[Sequence[Place]],
    scale: ScaleInput,
    options: ScaleOptions,
    *,
    object_height_m: float | None = None,
) -> tuple[DistanceAnalysis, ...]:
    """Measure several paths in an open image with one search.

    Args:
        raster: the image.
        paths: results of ``read_path``, in the caller's coordinates.
        scale: the known scale, or the analysis that finds it.
        options: all options of the scale estimate.
        object_height_m: height of all paths above the ground.

    Raises:
        VehAnchorError: see ``Engine.measure_distance``.
    """
    options.frame.check(raster.grid)
    coordinates = CoordinateFrame(options.frame, raster.grid)
    in_image = [_path_in_image(path, coordinates) for path in paths]
    measurement_scale = find_measurement_scale(
        raster, scale, options, object_height_m=object_height_m
    )
    return tuple(
        DistanceAnalysis(
            _measure_path(path, coordinates, measurement_scale),
            scale=measurement_scale.analysis,
            nadir=measurement_scale.plane is None,
            grid=raster.grid,
        )
        for path in in_image
    )


def _path_in_image(path: Sequence[Place], coordinates: CoordinateFrame) -> list[Place]:
    """Convert a path to pixels of the full image and check it against the image.

    Raises:
        PromptError: a point is outside the image, or the path is too short.
    """
    for point in path:
        if not coordinates.inside([point]):
            x, y = point
            raise PromptError(
                f"point {x:g}, {y:g} is not inside the {coordinates.name}"
                f"{coordinates.other_reading(path)}"
            )
    points = [coordinates.in_image(x, y) for x, y in path]
    length_px = _length(points)
    if length_px < MIN_PATH_PX:
        raise PromptError(
            f"the path is {length_px:.3g} px of the full image long: at least {MIN_PATH_PX:g} px "
            f"are needed{coordinates.other_reading(path)}"
        )
    return points


def _length(points: Sequence[Place]) -> float:
    return sum(math.dist(first, second) for first, second in pairwise(points))


def _length_sd(points: Sequence[Place], unit_px: tuple[float, float]) -> float:
    """Compute the standard deviation of a path's length, pixels, from the errors of its points.

    Args:
        points: path in pixels of the full image.
        unit_px: finest step of the caller's coordinates across and down, pixels.
    """
    legs = np.diff(np.array(points), axis=0)
    lengths = np.hypot(*legs.T)[:, None]
    # Unit vectors of the legs; zero where two points coincide.
    directions = np.zeros_like(legs)
    np.divide(legs, lengths, out=directions, where=lengths > 0)
    # Derivative of the length by each point: the difference of the directions before and after it.
    # On a straight line it is 0, so a stop on the way adds no error.
    gradient = np.diff(directions, axis=0, prepend=0.0, append=0.0)
    errors_px = gradient * unit_px * _POINT_SD
    return float(np.hypot.reduce(errors_px.ravel()))


def _measure_path(
    points: Sequence[Place], coordinates: CoordinateFrame, scale: MeasurementScale
) -> DistanceMeasurement:
    """Make the record from path and scale."""
    length_px = _length(points)
    distance = None
    low = None
    high = None
    if scale.gsd_m_per_px is not None:
        if scale.plane is None:
            distance = scale.gsd_m_per_px * length_px
        else:
            legs_m = scale.plane.length(points[:-1], points[1:])
            distance = float(legs_m.sum())
        log_sd = _length_sd(points, coordinates.unit_px) / length_px
        spread = scale.spread.plus(log_sd)
        low, high = spread.around(distance)
    path = image_points(coordinates.grid.to_file(points))
    status = scale.status
    notices = scale.notices
    if is_path_beside(points, scale.part):
        notices = (*notices, BESIDE_PHOTOGRAPH)
        if status == "ok":
            status = "low_confidence"
    return DistanceMeasurement(
        status=status,
        distance_m=distance,
        distance_ci95_low_m=low,
        distance_ci95_high_m=high,
        length_px=length_px,
        path=path,
        warnings=notices,
        **scale.fields(coordinates.grid),
    )
