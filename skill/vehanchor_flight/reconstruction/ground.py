"""The ground in a model: a plane below each shot, fitted to the points in its picture."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from vehanchor.errors import ReconstructionError
from vehanchor.records.text import count

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor_flight.reconstruction.model import Reconstruction, Shot

    Points: TypeAlias = NDArray[np.float64]
    """Points ``[n, 3]`` in model units."""

    Vector: TypeAlias = NDArray[np.float64]
    """Point or direction ``[3]``."""

    Heights: TypeAlias = NDArray[np.float64]
    """Heights ``[n]`` above a plane, model units."""

_MIN_POINTS = 20
_MAX_POINTS = 4000  # For a fit.
_N_TRIALS = 400
_MAX_DESCENTS = 8  # From one roof to a lower one.
_SEED = 5
_MIN_CROSS_PRODUCT = 1e-12  # Below it, three points lie in a line.
_THICKNESS = 0.015  # Of the ground, as a share of the cameras' height above it.
# A plane below another is the ground if it has this share of its points: roofs are planes too.
_MIN_LOWER_SHARE = 0.2
# The model's plane holds for a picture if it has this share of the points of the fitted plane.
_MIN_WHOLE_SHARE = 0.6
# Slope of the ground below one shot against that of the whole model: 15 degrees.
_MAX_SLOPE = 0.26
_MIN_COSINE = math.cos(math.atan(_MAX_SLOPE))
_N_NEIGHBOURS = 12  # Points around an object.
_MAX_NEIGHBOUR_DISTANCE = 0.25  # As a share of the camera's height.
# Quantile of their heights: car parks have cars and trees beside their asphalt.
_GROUND_QUANTILE = 0.3


@dataclass(frozen=True, eq=False)
class Plane:
    """Ground plane in model units: points X with ``normal X = offset``.

    Attributes:
        normal: ``[3]`` unit vector upwards.
        offset: distance from the model's origin.
    """

    normal: Vector
    offset: float

    def heights(self, points: Points) -> Heights:
        """Compute the heights ``[n]`` of points ``[n, 3]`` above the plane."""
        distances = points @ self.normal
        return np.asarray(distances - self.offset)

    def below(self, point: Vector, whole_plane: Plane) -> float:
        """Compute how far the plane lies below a point.

        Args:
            point: ``[3]``.
            whole_plane: plane of the model; the distance is along its normal.
        """
        height = point @ self.normal - self.offset
        cosine = self.normal @ whole_plane.normal
        return float(height / cosine)

    def height(self, point: Vector) -> float:
        """Compute the height of a point ``[3]`` above the plane."""
        return float(self.heights(point[None])[0])


def model_plane(model: Reconstruction) -> Plane:
    """Find the ground of a whole model: the lowest plane with enough of its points.

    Raises:
        ReconstructionError: the model has too few points.
    """
    centres = np.array([shot.centre for shot in model.shots])
    is_finite = np.isfinite(model.points).all(axis=1)
    points = _thinned(model.points[is_finite])
    if len(points) < _MIN_POINTS:
        n_points = count(len(points), "point")
        raise ReconstructionError(
            f"the model has {n_points}, too few for its ground: give the whole project"
        )
    camera = np.median(centres, axis=0)
    distances = np.linalg.norm(points - camera, axis=1)
    thickness = _THICKNESS * float(np.median(distances))
    most_common = _most_common(points, thickness)
    plane = _facing(most_common, camera)
    return _lowest(plane, points, thickness=thickness, whole_plane=plane)


def plane_below(shot: Shot, points: Points, whole_plane: Plane) -> Plane:
    """Fit the ground in the picture of a shot.

    Args:
        shot: the shot.
        points: ``[n, 3]`` points of the model in its picture.
        whole_plane: plane of the model.

    Returns:
        The plane of the model if it holds here, or if the picture has too few points; else the
        fitted one.

    Raises:
        ReconstructionError: the camera is not above the ground.
    """
    height = whole_plane.height(shot.centre)
    if height <= 0:
        raise ReconstructionError("the camera lies below the ground of the model")
    used_points = _thinned(points)
    if len(used_points) < _MIN_POINTS:
        return whole_plane
    thickness = _THICKNESS * height
    # The plane with most points may be a roof: descend from it to the ground.
    highest = _most_common(used_points, thickness, whole_plane)
    fitted = _lowest(highest, used_points, thickness=thickness, whole_plane=whole_plane)
    if fitted.height(shot.centre) <= 0:
        return whole_plane
    # The plane of the model is more reliable, if the ground is level.
    n_whole = _n_points_in(whole_plane, used_points, thickness)
    n_fitted = _n_points_in(fitted, used_points, thickness)
    if n_whole >= _MIN_WHOLE_SHARE * n_fitted:
        return whole_plane
    return fitted


def local_heights(
    places: Points,
    points: Points,
    plane: Plane,
    camera_height: float,
) -> Heights:
    """Measure the ground around objects, above the plane.

    Args:
        places: ``[m, 3]`` positions of the objects.
        points: ``[n, 3]`` points of the model around them.
        plane: the plane.
        camera_height: height of the camera above it, model units.

    Returns:
        ``[m]`` heights, model units; 0 where too few points are near.
    """
    heights = np.zeros(len(places))
    if len(points) < _N_NEIGHBOURS or not len(places):
        return heights
    # Neighbours are those whose feet on the plane are near: a roof beside a car is far above it.
    point_heights = plane.heights(points)
    place_heights = plane.heights(places)
    point_feet = points - point_heights[:, None] * plane.normal
    place_feet = places - place_heights[:, None] * plane.normal
    tree = cKDTree(point_feet)
    distances, neighbours = tree.query(place_feet, k=_N_NEIGHBOURS)
    is_close = distances[:, -1] <= _MAX_NEIGHBOUR_DISTANCE * camera_height
    neighbour_heights = point_heights[neighbours[is_close]]
    heights[is_close] = np.quantile(neighbour_heights, _GROUND_QUANTILE, axis=1)
    return heights


def _lowest(plane: Plane, points: Points, thickness: float, whole_plane: Plane) -> Plane:
    """Descend from a plane of roofs to the ground: the lowest plane with enough points.

    Args:
        plane: to begin with.
        points: ``[n, 3]`` points of the model.
        thickness: half of the plane's thickness.
        whole_plane: plane of the model.
    """
    n_in_plane = _n_points_in(plane, points, thickness)
    n_needed = max(_MIN_POINTS, _MIN_LOWER_SHARE * n_in_plane)
    # Lower means lower in the middle of the points. Otherwise the two slopes of a hill would take
    # turns for ever, because each has points below the other.
    middle = np.median(points, axis=0)
    for _ in range(_MAX_DESCENTS):
        heights = plane.heights(points)
        is_below = heights < -2 * thickness
        points = points[is_below]
        if len(points) < n_needed:
            break
        lower = _most_common(points, thickness, whole_plane)
        if _n_points_in(lower, points, thickness) < n_needed:
            break
        if lower.below(middle, whole_plane) <= plane.below(middle, whole_plane):
            break
        plane = lower
    return plane


def _n_points_in(plane: Plane, points: Points, thickness: float) -> int:
    distances = np.abs(plane.heights(points))
    return int((distances <= thickness).sum())


def _facing(plane: Plane, point: Vector) -> Plane:
    """Turn the normal of a plane to the side of a point ``[3]``."""
    if plane.height(point) >= 0:
        return plane
    return Plane(-plane.normal, -plane.offset)


def _thinned(points: Points) -> Points:
    """Take every k-th point, so that no more than a fit needs remain."""
    step = math.ceil(len(points) / _MAX_POINTS)
    step = max(1, step)
    return points[::step]


def _most_common(
    points: Points,
    thickness: float,
    whole_plane: Plane | None = None,
) -> Plane:
    """Find the plane with most points within its thickness; a least-squares fit to them follows.

    Args:
        points: ``[n, 3]``, at least three.
        thickness: half of the plane's thickness.
        whole_plane: plane whose normal the result has, within 15 degrees; None for any normal. A
            house has walls, and the fit to a thin strip of one would be the wall.
    """
    sample = _best_sample(points, thickness, whole_plane)
    if sample is None and whole_plane is not None:
        # No slope fits: as steep as the model, at the middle height.
        heights = whole_plane.heights(points)
        middle = float(np.median(heights))
        return Plane(whole_plane.normal, whole_plane.offset + middle)
    inside = np.ones(len(points), dtype=bool)
    if sample is not None:
        inside = sample.is_inside
    inner = points[inside]
    centre = inner.mean(axis=0)
    # The normal of the least-squares plane is the direction in which the points vary least.
    _, _, directions = np.linalg.svd(inner - centre, full_matrices=False)
    normal = directions[2]
    if sample is not None and whole_plane is not None:
        if abs(normal @ whole_plane.normal) < _MIN_COSINE:
            normal = sample.normal
        if normal @ whole_plane.normal <= 0:
            normal = -normal
    return Plane(normal, float(normal @ centre))


class _Sample(NamedTuple):
    """Plane through three points.

    Attributes:
        normal: ``[3]`` unit vector.
        is_inside: ``[n]``, points within the thickness.
    """

    normal: Vector
    is_inside: NDArray[np.bool_]


def _best_sample(
    points: Points,
    thickness: float,
    whole_plane: Plane | None,
) -> _Sample | None:
    """Try planes through random points (RANSAC); arguments as in ``_most_common``.

    Returns:
        The plane with most points; None if no three points give an allowed one.
    """
    rng = np.random.default_rng(_SEED)
    best: _Sample | None = None
    most_inside = 0
    for _ in range(_N_TRIALS):
        three = rng.choice(len(points), 3, replace=False)
        a, b, c = points[three]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < _MIN_CROSS_PRODUCT:
            continue
        if whole_plane is not None:
            cosine_times_length = abs(normal @ whole_plane.normal)
            if cosine_times_length < _MIN_COSINE * length:
                continue
        normal /= length
        distances = np.abs((points - a) @ normal)
        is_inside = distances <= thickness
        n_inside = int(is_inside.sum())
        if n_inside > most_inside:
            best = _Sample(normal, is_inside)
            most_inside = n_inside
    return best
