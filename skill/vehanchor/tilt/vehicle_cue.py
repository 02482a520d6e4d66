"""Vehicles as a tilt cue: in a tilted view nearer cars are larger.

The mean size of a pixel on the ground is ``(n d)^-1.5`` times that of a pixel at nadir (``vehanchor.scale.plane``). The
square root of a car's area in the image is therefore proportional to ``(n d)^1.5`` for any direction of the car.
Foreshortening is not used: a car that points away also shows its end, which compensates most of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.scale.plane import LEAST_DESCENT

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.detection.detections import Detections

LEAST_CARS = 25
_MOST_CARS = 250  # the most certain ones; more do not narrow the posterior
_LEAST_SCORE = 0.5
_LOG_SD = 0.11  # of the square root of box areas within one fleet
_FREEDOM = 3.0  # degrees of freedom of Student's distribution, robust against lorries
_TRUST, _MOST_COUNTED = 0.5, 80  # neighbouring cars are correlated, and so are the cars of a part of town
_FACTOR = 4.0  # largest ratio of a car's length to the median, in either direction


@dataclass(frozen=True, eq=False)
class VehicleCue:
    """Sizes of cars over the image (a ``vehanchor.tilt.posterior.TiltCue``).

    Attributes:
        places: ``[n, 2]`` pixels from the image's centre.
        sizes: ``[n]`` natural logs of the root of each one's area in the image.
    """

    places: NDArray[np.float64]
    sizes: NDArray[np.float64]
    kind: str = "vehicles"

    @property
    def trust(self) -> float:
        """Weight of each car: neighbouring cars are alike, so that n of them count less than n."""
        return _TRUST * min(1.0, _MOST_COUNTED / len(self.sizes))

    def log_likelihoods(self, downs: NDArray[np.float64], focal_px: float) -> NDArray[np.float64]:
        """Compute ``[k]``; minus infinity if a car would lie above the horizon."""
        rays = np.column_stack([self.places / focal_px, np.ones(len(self.places))]).astype(np.float32)
        sizes = rays @ downs.T.astype(np.float32)  # [n, k]; float32 errs by 0.001 nats and halves the time
        seen = (sizes >= LEAST_DESCENT * np.linalg.norm(rays, axis=1)[:, None]).all(axis=0)
        np.log(np.maximum(sizes, 1e-6, out=sizes), out=sizes)
        sizes *= -1.5
        sizes += self.sizes.astype(np.float32)[:, None]  # as at nadir
        ranked = np.sort(sizes, axis=0)
        sizes -= (ranked[(len(sizes) - 1) // 2] + ranked[len(sizes) // 2]) / 2
        sizes *= 1 / _LOG_SD
        np.log1p(sizes * sizes / _FREEDOM, out=sizes)
        logs = -(_FREEDOM + 1) / 2 * sizes.sum(axis=0, dtype=np.float64)
        return np.asarray(np.where(seen, self.trust * logs, -math.inf))


def vehicle_cue(detections: Detections, width_px: int, height_px: int) -> VehicleCue | None:
    """Make a tilt cue of the cars of an image.

    Args:
        detections: vehicles in pixels of the image.
        width_px: width of the image.
        height_px: height of the image.

    Returns:
        None for fewer than 25 certain cars that lie completely in the image.
    """
    boxes = _whole_cars(detections, width_px, height_px)
    if len(boxes) < LEAST_CARS:
        return None
    return VehicleCue(boxes[:, :2] - [width_px / 2, height_px / 2], np.log(boxes[:, 2] * boxes[:, 3]) / 2)


def _whole_cars(detections: Detections, width_px: int, height_px: int) -> NDArray[np.float64]:
    """Select boxes ``[n, 5]`` of likely cars that lie completely in the image, the most certain first."""
    sure = detections.scores >= _LEAST_SCORE
    boxes, scores = detections.boxes[sure], detections.scores[sure]
    if not len(boxes):
        return boxes
    reach = boxes[:, 2] / 2
    inside = (boxes[:, 0] > reach) & (boxes[:, 0] < width_px - reach)
    inside &= (boxes[:, 1] > reach) & (boxes[:, 1] < height_px - reach)
    ratio = boxes[:, 2] / np.median(boxes[:, 2])
    inside &= (ratio < _FACTOR) & (ratio > 1 / _FACTOR)
    kept = np.argsort(-scores[inside], kind="stable")[:_MOST_CARS]
    return np.asarray(boxes[inside][kept])
