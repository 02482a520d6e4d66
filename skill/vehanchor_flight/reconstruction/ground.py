"""The ground in a model: a plane below each shot, fitted to the points in its picture."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from vehanchor.errors import ReconstructionError
from vehanchor.records.text import count

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor_flight.reconstruction.model import Reconstruction, Shot

_LEAST_POINTS = 20
_MOST_POINTS = 4000  # for a fit
_TRIALS = 400
_MOST_DESCENTS = 8  # from one roof to a lower one
_SEED = 5
_LEAST_CROSS = 1e-12  # three points in a line
_THICKNESS = 0.015  # of the ground, as a share of the cameras' height above it
# a plane below another is the ground if it has this share of its points: roofs are planes too
_LOWER_SHARE = 0.2
# the model's plane holds for a picture in which it has this share of the points of the own plane
_WHOLE_SHARE = 0.6
_STEEPEST = 0.26  # slope of the ground below one shot against that of the whole model: 15 degrees
_NEAREST = 12  # points around an object
_AROUND = 0.25  # they lie no farther away than this share of the camera's height
_LOW = 0.3  # quantile of their heights: car parks have cars and trees beside their asphalt


@dataclass(frozen=True, eq=False)
class Plane:
    """Ground plane in model units: points X with ``normal X = offset``.

    Attributes:
        normal: ``[3]`` unit vector upwards.
        offset: distance from the model's origin.
    """

    normal: NDArray[np.float64]
    offset: float

    def heights(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Compute heights ``[n]`` of points ``[n, 3]`` above the plane."""
        return np.asarray(points @ self.normal - self.offset)

    def below(self, point: NDArray[np.float64], whole: Plane) -> float:
        """Compute how far the plane lies below a point ``[3]``, along the normal of the model's plane."""
        return float((point @ self.normal - self.offset) / (self.normal @ whole.normal))


def model_plane(model: Reconstruction) -> Plane:
    """Find the plane with most points of a model below its cameras.

    Raises:
        ReconstructionError: the model has too few points, or none lie below the cameras.
    """
    centres = np.array([shot.centre for shot in model.shots])
    points = _thinned(model.points[np.isfinite(model.points).all(axis=1)])
    if len(points) < _LEAST_POINTS:
        raise ReconstructionError(
            f"the model has {count(len(points), 'point')}, too few for its ground: give the "
            "whole project"
        )
    distance = float(np.median(np.linalg.norm(points - np.median(centres, axis=0), axis=1)))
    thickness = _THICKNESS * distance
    found = _upwards(_most_common(points, thickness), np.median(centres, axis=0))
    return _lowest(found, points, thickness=thickness, whole=found)


def plane_below(shot: Shot, points: NDArray[np.float64], whole: Plane) -> Plane:
    """Fit the ground in the picture of a shot.

    Args:
        shot: the shot.
        points: ``[n, 3]`` points of the model in its picture.
        whole: plane of the model.

    Returns:
        The plane of the model if it holds here, or if the picture has too few points; else the
        fitted one.

    Raises:
        ReconstructionError: the camera is not above the ground.
    """
    height = float(whole.heights(shot.centre[None])[0])
    if height <= 0:
        raise ReconstructionError("the camera lies below the ground of the model")
    chosen = _thinned(points)
    if len(chosen) < _LEAST_POINTS:
        return whole
    thickness = _THICKNESS * height
    found = _lowest(
        _most_common(chosen, thickness, whole), chosen, thickness=thickness, whole=whole
    )
    holds = _support(whole, chosen, thickness) >= _WHOLE_SHARE * _support(found, chosen, thickness)
    return whole if holds or found.heights(shot.centre[None])[0] <= 0 else found


def local_heights(
    places: NDArray[np.float64], points: NDArray[np.float64], plane: Plane, camera_height: float
) -> NDArray[np.float64]:
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
    if len(points) < _NEAREST or not len(places):
        return heights
    above = plane.heights(points)
    feet = points - above[:, None] * plane.normal
    apart, near = cKDTree(feet).query(
        places - plane.heights(places)[:, None] * plane.normal, k=_NEAREST
    )
    close = apart[:, -1] <= _AROUND * camera_height
    heights[close] = np.quantile(above[near[close]], _LOW, axis=1)
    return heights


def _lowest(plane: Plane, points: NDArray[np.float64], thickness: float, whole: Plane) -> Plane:
    """Descend from a plane of roofs to the ground: the lowest plane with enough points.

    Lower means lower in the middle of the points: the two slopes of a hill would take turns for
    ever.
    """
    least = max(_LEAST_POINTS, _LOWER_SHARE * _support(plane, points, thickness))
    middle = np.median(points, axis=0)
    for _ in range(_MOST_DESCENTS):
        points = points[plane.heights(points) < -2 * thickness]
        if len(points) < least:
            break
        found = _most_common(points, thickness, whole)
        if _support(found, points, thickness) < least or found.below(middle, whole) <= plane.below(
            middle, whole
        ):
            break
        plane = found
    return plane


def _support(plane: Plane, points: NDArray[np.float64], thickness: float) -> int:
    return int((np.abs(plane.heights(points)) <= thickness).sum())


def _upwards(plane: Plane, above: NDArray[np.float64]) -> Plane:
    """Turn the normal to the side of a point ``[3]``."""
    return plane if plane.heights(above[None])[0] >= 0 else Plane(-plane.normal, -plane.offset)


def _thinned(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return points[:: -(-len(points) // _MOST_POINTS) or 1]


def _most_common(
    points: NDArray[np.float64], thickness: float, whole: Plane | None = None
) -> Plane:
    """Find the plane with most points within its thickness; a least-squares fit to them follows.

    Args:
        points: ``[n, 3]``, at least three.
        thickness: half of the plane's thickness.
        whole: plane whose normal the found one has, within 15 degrees: a house has faces, and the
            fit to a thin strip of one would be the face; None for any normal.
    """
    rng = np.random.default_rng(_SEED)
    steepest = 0.0 if whole is None else math.cos(math.atan(_STEEPEST))
    best = np.ones(len(points), dtype=bool)
    most = 0
    tried = np.zeros(3)
    for _ in range(_TRIALS):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        size = float(np.linalg.norm(normal))
        if size < _LEAST_CROSS or (
            whole is not None and abs(normal @ whole.normal) < steepest * size
        ):
            continue
        normal /= size
        inside = np.abs((points - a) @ normal) <= thickness
        if int(inside.sum()) > most:
            best = inside
            most = int(inside.sum())
            tried = normal
    # no slope fits: as steep as the model, at the middle height
    if whole is not None and most == 0:
        return Plane(whole.normal, whole.offset + float(np.median(whole.heights(points))))
    centre = points[best].mean(axis=0)
    normal = np.linalg.svd(points[best] - centre, full_matrices=False)[2][2]
    if whole is not None:
        normal = normal if abs(normal @ whole.normal) >= steepest else tried
        normal = normal if normal @ whole.normal > 0 else -normal
    return Plane(normal, float(normal @ centre))
