"""The ground in a model: a plane below each shot, fitted to the points in its picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.errors import ReconstructionError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.flight.reconstruction.model import Reconstruction, Shot

_LEAST_POINTS = 20
_MOST_POINTS = 4000  # for a fit
_TRIALS = 400
_SEED = 5
_THICKNESS = 0.015  # of the ground, as a share of the cameras' height above it
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


def model_plane(model: Reconstruction) -> Plane:
    """Find the plane with most points of a model below its cameras.

    Raises:
        ReconstructionError: the model has too few points, or none lie below the cameras.
    """
    centres = np.array([shot.centre for shot in model.shots])
    points = _thinned(model.points[np.isfinite(model.points).all(axis=1)])
    if len(points) < _LEAST_POINTS:
        raise ReconstructionError(f"the model has {len(points)} points, too few for its ground: give the whole project")
    distance = float(np.median(np.linalg.norm(points - np.median(centres, axis=0), axis=1)))
    found = _most_common(points, _THICKNESS * distance)
    if np.median(found.heights(centres)) < 0:
        found = Plane(-found.normal, -found.offset)
    return found


def plane_below(shot: Shot, points: NDArray[np.float64], whole: Plane) -> Plane:
    """Fit the ground in the picture of a shot.

    Args:
        shot: the shot.
        points: ``[n, 3]`` points of the model in its picture.
        whole: plane of the model.

    Returns:
        The fitted plane; that of the model if the picture has too few points or a steep face.

    Raises:
        ReconstructionError: the camera is not above the ground.
    """
    height = float(whole.heights(shot.centre[None])[0])
    if height <= 0:
        raise ReconstructionError("the camera lies below the ground of the model")
    chosen = _thinned(points)
    if len(chosen) < _LEAST_POINTS:
        return whole
    found = _most_common(chosen, _THICKNESS * height)
    if found.normal @ whole.normal < 0:
        found = Plane(-found.normal, -found.offset)
    level = float(found.normal @ whole.normal) >= np.cos(np.arctan(_STEEPEST))
    return found if level and found.heights(shot.centre[None])[0] > 0 else whole


def local_heights(
    places: NDArray[np.float64], points: NDArray[np.float64], plane: Plane, camera_height: float
) -> NDArray[np.float64]:
    """Measure the ground around objects, above the plane.

    Args:
        places: ``[m, 3]`` positions of the objects on the plane.
        points: ``[n, 3]`` points of the model around them.
        plane: the plane.
        camera_height: height of the camera above it, model units.

    Returns:
        ``[m]`` heights, model units; 0 where too few points are near.
    """
    heights = np.zeros(len(places))
    if len(points) < _NEAREST:
        return heights
    above = plane.heights(points)
    feet = points - above[:, None] * plane.normal
    for k, place in enumerate(places):
        apart = np.linalg.norm(feet - place, axis=1)
        near = np.argpartition(apart, _NEAREST - 1)[:_NEAREST]
        if apart[near].max() <= _AROUND * camera_height:
            heights[k] = np.quantile(above[near], _LOW)
    return heights


def _thinned(points: NDArray[np.float64]) -> NDArray[np.float64]:
    return points[:: -(-len(points) // _MOST_POINTS) or 1]


def _most_common(points: NDArray[np.float64], thickness: float) -> Plane:
    """Find the plane with most points within its thickness; a least-squares fit to them follows."""
    rng = np.random.default_rng(_SEED)
    best, most = np.ones(len(points), dtype=bool), 0
    for _ in range(_TRIALS):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        size = float(np.linalg.norm(normal))
        if size < 1e-12:
            continue
        inside = np.abs((points - a) @ (normal / size)) <= thickness
        if int(inside.sum()) > most:
            best, most = inside, int(inside.sum())
    for _ in range(2):
        centre = points[best].mean(axis=0)
        normal = np.linalg.svd(points[best] - centre, full_matrices=False)[2][2]
        inside = np.abs((points - centre) @ normal) <= thickness
        if inside.sum() < 3:
            break
        best = inside
    return Plane(normal, float(normal @ centre))
