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
from vehanchor.measure.scale_source import find_measurement_scale
from vehanchor.options import ScaleOptions
from vehanchor.options.reading import CoordinateFrame
from vehanchor.records import DistanceMeasurement, ImagePoint
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
# of a point, in the finest step of the caller's coordinates, as for lines of known length
_POINT_SD = 1.0


def read_path(path: Sequence[Place]) -> tuple[Place, ...]:
    """Read and check a path of the caller: points, or a line of shapely.

    Raises:
        PromptError: another geometry, fewer than two points, or one that is not two finite numbers.
    """
    try:
        given: Any = getattr(path, "coords", path)
    except NotImplementedError:  # of shapely's polygons and collections
        given = None
    if isinstance(given, str) or not isinstance(given, Iterable):
        raise PromptError(f"the path is {path!r}: give a line, or points as x, y")
    places = []
    for each in given:
        x, y = read_numbers(each, (2,), name="a point of the path", expected="x, y")
        places.append((x, y))
    if not 2 <= len(places) <= MAX_PATH_POINTS:
        n = count(len(places), "point")
        raise PromptError(f"the path has {n}: give two, or up to {MAX_PATH_POINTS} along a line")
    return tuple(places)


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
        VehAnchorError: as ``Engine.measure_distance``.
    """
    options.frame.check(raster.width_px, raster.height_px)
    coordinates = CoordinateFrame(options.frame, raster.width_px, raster.height_px)
    in_image = [_in_image(path, coordinates) for path in paths]
    found = find_measurement_scale(raster, scale, options, object_height_m=object_height_m)
    return tuple(
        DistanceAnalysis(
            _conclude(path, coordinates, found), scale=found.analysis, nadir=found.plane is None
        )
        for path in in_image
    )


def _in_image(path: Sequence[Place], coordinates: CoordinateFrame) -> list[Place]:
    outside = next((place for place in path if not coordinates.inside([place])), None)
    if outside is not None:
        raise PromptError(
            f"point {outside[0]:g}, {outside[1]:g} is not inside the {coordinates.name}"
            f"{coordinates.other_reading(path)}"
        )
    places = [coordinates.in_image(*place) for place in path]
    length_px = _length(places)
    if length_px < MIN_PATH_PX:
        raise PromptError(
            f"the path is {length_px:.3g} px of the full image long: at least {MIN_PATH_PX:g} "
            "px are needed"
            f"{coordinates.other_reading(path)}"
        )
    return places


def _length(places: Sequence[Place]) -> float:
    return sum(math.dist(first, second) for first, second in pairwise(places))


def _length_sd(places: Sequence[Place], unit_px: tuple[float, float]) -> float:
    """Compute the standard deviation of a path's length, pixels, from an error of one step of coordinates per point."""
    legs = np.diff(np.array(places), axis=0)
    reach = np.hypot(legs[:, 0], legs[:, 1])[:, None]
    along = np.divide(legs, reach, out=np.zeros_like(legs), where=reach > 0)
    # of the length by each point; 0 on a straight line
    gradient = np.diff(along, axis=0, prepend=0.0, append=0.0)
    return float(np.hypot.reduce((gradient * unit_px * _POINT_SD).ravel()))


def _conclude(
    places: Sequence[Place], coordinates: CoordinateFrame, scale: MeasurementScale
) -> DistanceMeasurement:
    """Make the record from path and scale."""
    length_px = _length(places)
    gsd = scale.gsd_m_per_px
    distance = None
    low = None
    high = None
    if gsd is not None:
        plane = scale.plane
        distance = (
            gsd * length_px if plane is None else float(plane.length(places[:-1], places[1:]).sum())
        )
        low, high = scale.spread.plus(_length_sd(places, coordinates.unit_px) / length_px).around(
            distance
        )
    return DistanceMeasurement(
        status=scale.status,
        distance_m=distance,
        distance_ci95_low_m=low,
        distance_ci95_high_m=high,
        length_px=length_px,
        path=tuple(ImagePoint(x_px=x, y_px=y) for x, y in places),
        warnings=scale.notices,
        **scale.fields(coordinates.width_px, coordinates.height_px),
    )
