"""Tilt from the cars themselves: where the camera looked aside, nearer cars are larger.

A pixel is ``(n d)^-1.5`` as wide and high, at the mean, as one straight below (``vehanchor.scale.plane``),
so the root of a car's area in the image goes as ``(n d)^1.5``, whichever way it stands. Its foreshortening is no
evidence: a car that points away shows its end, too, which makes up for most of it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.camera import MAX_OFF_NADIR_DEG, equivalent_lens, lens, taken_ratio
from vehanchor.scale.plane import LEAST_DESCENT
from vehanchor.tilt.posterior import Focal, tilt_posterior

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.detection.detections import Detections
    from vehanchor.options import ScaleOptions
    from vehanchor.rulers.evidence import ImageFacts, View
    from vehanchor.tilt.posterior import TiltPosterior

LEAST_CARS = 25
_MOST_CARS = 250  # the surest: more do not make it surer
_LEAST_SCORE = 0.5
_LOG_SD = 0.11  # of the root of a box's area among cars of one fleet: length and width together
_FREEDOM = 3.0  # of Student's distribution: a lorry among them must not lean the ground
_TRUST, _MOST_COUNTED = 0.5, 80  # those that stand side by side are alike, and a part of town has cars of its own
_USUAL_FOCAL_35MM = 26.0  # of drones' cameras, where nothing tells it
_USUAL_LOG_SD = 0.2  # 20 to 35 mm
_DOUBT = 0.3  # chance of more than ten degrees from which it is looked for elsewhere, too
SURE = 0.99  # chance of more than ten degrees from which it is told
_FACTOR = 4.0  # cars are at most so much larger or smaller than their median


@dataclass(frozen=True, eq=False)
class VehicleCue:
    """Cars that are larger on the nearer side (a ``vehanchor.tilt.posterior.TiltCue``).

    Attributes:
        places: ``[n, 2]`` pixels from the image's centre.
        sizes: ``[n]`` natural logs of the root of each one's area in the image.
    """

    places: NDArray[np.float64]
    sizes: NDArray[np.float64]
    kind: str = "vehicles"

    @property
    def trust(self) -> float:
        """What each counts of a car that nothing binds to the others."""
        return _TRUST * min(1.0, _MOST_COUNTED / len(self.sizes))

    def log_likelihoods(self, downs: NDArray[np.float64], focal_px: float) -> NDArray[np.float64]:
        """``[k]``; minus infinity where one of them would lie above the horizon."""
        rays = np.column_stack([self.places / focal_px, np.ones(len(self.places))]).astype(np.float32)
        sizes = rays @ downs.T.astype(np.float32)  # [n, k], single: a thousandth of a nat, in half the time
        seen = (sizes >= LEAST_DESCENT * np.linalg.norm(rays, axis=1)[:, None]).all(axis=0)
        np.log(np.maximum(sizes, 1e-6, out=sizes), out=sizes)
        sizes *= -1.5
        sizes += self.sizes.astype(np.float32)[:, None]  # as they would be from straight above
        ranked = np.sort(sizes, axis=0)
        sizes -= (ranked[(len(sizes) - 1) // 2] + ranked[len(sizes) // 2]) / 2
        sizes *= 1 / _LOG_SD
        np.log1p(sizes * sizes / _FREEDOM, out=sizes)
        logs = -(_FREEDOM + 1) / 2 * sizes.sum(axis=0, dtype=np.float64)
        return np.asarray(np.where(seen, self.trust * logs, -math.inf))


def vehicle_cue(detections: Detections, width_px: int, height_px: int) -> VehicleCue | None:
    """Make a witness of the cars of an image.

    Args:
        detections: vehicles in pixels of the image.
        width_px: of the image.
        height_px: of the image.

    Returns:
        None for fewer than 25 cars that are surely some and lie whole in the image.
    """
    boxes = _whole_cars(detections, width_px, height_px)
    if len(boxes) < LEAST_CARS:
        return None
    return VehicleCue(boxes[:, :2] - [width_px / 2, height_px / 2], np.log(boxes[:, 2] * boxes[:, 3]) / 2)


def focal_of(image: ImageFacts, options: ScaleOptions) -> Focal:
    """The focal length as far as the caller or the metadata tell it; else that of most drones, with a wide spread.

    Args:
        image: its size and camera.
        options: what the caller says, and whether metadata are to be read.
    """
    said, camera = options.rulers.focal_35mm, image.camera if options.rulers.metadata else None
    seen = None if camera is None else lens(image, camera)
    if said is not None:
        seen = equivalent_lens(image.width_px, image.height_px, said)
    if seen is not None:
        return Focal(seen.pixels, seen.log_sd)
    return usual_focal(image.width_px, image.height_px)


def usual_focal(width_px: int, height_px: int) -> Focal:
    """The focal length of most drones' cameras, and how far it may be off."""
    return Focal(equivalent_lens(width_px, height_px, _USUAL_FOCAL_35MM).pixels, _USUAL_LOG_SD, known=False)


def may_be_tilted(view: View) -> bool:
    """Whether nothing tells where the camera looked: no metadata, no georeference, no cars that see it look down."""
    image, camera = view.image, view.image.camera if view.options.rulers.metadata else None
    if image.georeference_gsd_m_per_px is not None or (camera is not None and camera.off_nadir_deg is not None):
        return False
    seen = _seen_by_cars(view)
    return seen is None or seen[1].chance_above(MAX_OFF_NADIR_DEG) >= _DOUBT


def tilt_from_vehicles(
    detections: Detections, width_px: int, height_px: int, focal_px: float | None = None
) -> TiltPosterior | None:
    """Estimate from cars alone where the camera looked.

    Args:
        detections: vehicles in pixels of the image.
        width_px: of the image.
        height_px: of the image.
        focal_px: focal length, pixels; None where nothing tells it.

    Returns:
        None for fewer than 25 cars that are surely some and lie whole in the image.
    """
    cars = vehicle_cue(detections, width_px, height_px)
    focal = Focal(focal_px, 0.0) if focal_px else usual_focal(width_px, height_px)
    return None if cars is None else tilt_posterior([cars], focal)


def tilt_notice(view: View) -> list[Notice]:
    """Warn where the cars say that the camera looked aside, and nothing else tells where; or metadata, of a crop.

    Args:
        view: of the image, with its vehicles as they are in it.

    Returns:
        One notice, or none.
    """
    image, camera = view.image, view.image.camera if view.options.rulers.metadata else None
    if image.georeference_gsd_m_per_px is not None:
        return []
    if camera is not None and camera.off_nadir_deg is not None:
        return _part_of_tilted(camera.off_nadir_deg) if taken_ratio(image, camera) is None else []
    seen = _seen_by_cars(view)
    if seen is None or seen[1].chance_above(MAX_OFF_NADIR_DEG) < SURE:
        return []
    n_cars, found = seen
    message = (
        f"The camera seems to have looked about {found.tilt_deg:.0f} degrees ({found.low_deg:.0f} to "
        f"{found.high_deg:.0f}) away from straight down: {n_cars} cars are larger on one side of the picture. "
        "Scales differ over it, and areas and lengths far from its middle are off: give the original file, whose "
        "metadata say where the camera looked, or a crop around the object."
    )
    return [Notice(code=NoticeCode.TILT_SUSPECTED, message=message)]


def _seen_by_cars(view: View) -> tuple[int, TiltPosterior] | None:
    """How many cars tell where the camera looked, and where, as finely as it takes to say whether it looked aside."""
    image = view.image
    cars = vehicle_cue(view.detections, image.width_px, image.height_px)
    found = None if cars is None else tilt_posterior([cars], focal_of(image, view.options), n_looks=2)
    return None if cars is None or found is None else (len(cars.sizes), found)


def _part_of_tilted(off_nadir_deg: float) -> list[Notice]:
    """A warning that the picture was taken aside of which the image is a crop, whose place in it nobody knows."""
    if off_nadir_deg <= MAX_OFF_NADIR_DEG:
        return []
    message = (
        f"By its metadata the camera looked {off_nadir_deg:.0f} degrees away from straight down, and the image is a "
        "crop of that picture, nobody knows which: it is measured as if from straight above. Scales differ over it, "
        "and areas and lengths may be off: give the original file."
    )
    return [Notice(code=NoticeCode.TILT_SUSPECTED, message=message)]


def _whole_cars(detections: Detections, width_px: int, height_px: int) -> NDArray[np.float64]:
    """``[n, 5]`` boxes that are cars rather than not, and not cut by the image's edge; the surest."""
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
