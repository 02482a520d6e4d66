"""Tilt from the cars themselves: where the camera looked aside, nearer cars are larger.

A pixel is ``(n d)^-1.5`` as wide and high, at the mean, as one straight below (``vehanchor.scale.plane``),
so the root of a car's area in the image goes as ``(n d)^1.5``, whichever way it stands. Its foreshortening is no
evidence: a car that points away shows its end, too, which makes up for most of it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.anchors.camera import MAX_OFF_NADIR_DEG, equivalent_lens, lens
from vehanchor.notices import NoticeCode
from vehanchor.records import Notice
from vehanchor.scale.plane import LEAST_DESCENT

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.anchors.evidence import View
    from vehanchor.detection.sighting import Sighting

__all__ = ["LEAST_CARS", "SURE", "Leaning", "lean", "leaning_notice"]

LEAST_CARS = 25
_LEAST_SCORE = 0.5
_LOG_SD = 0.11  # of the root of a box's area among cars of one fleet: length and width together
_FREEDOM = 3.0  # of Student's distribution: a lorry among them must not lean the ground
_TRUST = 0.5  # on the cars together: those that stand side by side are alike
_USUAL_FOCAL_35MM = (20.0, 26.0, 35.0)  # of drones' cameras, where nothing tells it
_TILTS_DEG = np.arange(0.0, 60.1, 1.5)
_ROLLS_DEG = np.arange(0.0, 360.0, 15.0)
SURE = 0.99  # chance of more than ten degrees from which it is told
_FACTOR = 4.0  # cars are at most so much larger or smaller than their median


class Leaning(NamedTuple):
    """Where cars say that the camera looked.

    Attributes:
        tilt_deg: angle between its axis and straight down, the median.
        low_deg: lower end of its 95 % interval.
        high_deg: upper end.
        roll_deg: direction in which it looked aside, clockwise from the image's upper side, the likeliest.
        chance_tilted: 0..1, that it looked more than ten degrees aside.
        n: cars that say so.
    """

    tilt_deg: float
    low_deg: float
    high_deg: float
    roll_deg: float
    chance_tilted: float
    n: int


def lean(sighting: Sighting, width_px: int, height_px: int, focal_px: float | None = None) -> Leaning | None:
    """Estimate from cars where the camera looked.

    Args:
        sighting: vehicles in pixels of the image.
        width_px: of the image.
        height_px: of the image.
        focal_px: focal length, pixels; None where nothing tells it: then the usual ones are tried.

    Returns:
        None for fewer than 25 cars that are surely some and lie whole in the image.
    """
    boxes = _whole_cars(sighting, width_px, height_px)
    if len(boxes) < LEAST_CARS:
        return None
    focals = (
        [focal_px] if focal_px else [equivalent_lens(width_px, height_px, each).pixels for each in _USUAL_FOCAL_35MM]
    )
    sizes = np.log(boxes[:, 2] * boxes[:, 3]) / 2
    logs = np.stack([_log_likelihoods(boxes[:, :2], sizes, width_px, height_px, focal) for focal in focals])
    posterior = np.exp(_TRUST * (logs - logs.max()))
    posterior /= posterior.sum()
    by_tilt = posterior.sum(axis=(0, 2))
    below = np.cumsum(by_tilt)
    low, median, high = np.interp([0.025, 0.5, 0.975], below, _TILTS_DEG)
    roll = _ROLLS_DEG[int(posterior.sum(axis=(0, 1)).argmax())]
    chance = float(by_tilt[_TILTS_DEG > MAX_OFF_NADIR_DEG].sum())
    return Leaning(float(median), float(low), float(high), float(roll), chance, len(boxes))


def leaning_notice(view: View) -> list[Notice]:
    """Warn where the cars say that the camera looked aside, and nothing else tells where it looked.

    Args:
        view: of the image, with its vehicles as they are in it.

    Returns:
        One notice, or none.
    """
    image, camera = view.image, view.image.camera if view.options.rulers.metadata else None
    if image.georeference_gsd_m_per_px is not None or (camera is not None and camera.off_nadir_deg is not None):
        return []
    seen = None if camera is None else lens(image, camera)
    found = lean(view.sighting, image.width_px, image.height_px, None if seen is None else seen.pixels)
    if found is None or found.chance_tilted < SURE:
        return []
    message = (
        f"The camera seems to have looked about {found.tilt_deg:.0f} degrees ({found.low_deg:.0f} to "
        f"{found.high_deg:.0f}) away from straight down: {found.n} cars are larger on one side of the picture. Scales "
        "differ over it, and areas and lengths far from its middle are off: give the original file, whose metadata say "
        "where the camera looked, or a crop around the object."
    )
    return [Notice(code=NoticeCode.TILT_SUSPECTED, message=message)]


def _whole_cars(sighting: Sighting, width_px: int, height_px: int) -> NDArray[np.float64]:
    """``[n, 5]`` boxes that are cars rather than not, and not cut by the image's edge."""
    boxes = sighting.boxes[sighting.scores >= _LEAST_SCORE]
    if not len(boxes):
        return boxes
    reach = boxes[:, 2] / 2
    inside = (boxes[:, 0] > reach) & (boxes[:, 0] < width_px - reach)
    inside &= (boxes[:, 1] > reach) & (boxes[:, 1] < height_px - reach)
    ratio = boxes[:, 2] / np.median(boxes[:, 2])
    return np.asarray(boxes[inside & (ratio < _FACTOR) & (ratio > 1 / _FACTOR)])


def _log_likelihoods(
    places: NDArray[np.float64], sizes: NDArray[np.float64], width_px: int, height_px: int, focal_px: float
) -> NDArray[np.float64]:
    """``[tilts, rolls]`` of cars at places with logs of sizes; minus infinity where one lies above the horizon."""
    tilts, rolls = np.radians(_TILTS_DEG)[:, None], np.radians(_ROLLS_DEG)[None, :]
    downs = np.stack([-np.sin(tilts) * np.sin(rolls), np.sin(tilts) * np.cos(rolls), np.cos(tilts) + 0 * rolls], axis=2)
    rays = np.column_stack([(places - [width_px / 2, height_px / 2]) / focal_px, np.ones(len(places))])
    descents = downs @ rays.T  # [tilts, rolls, cars]
    seen = (descents / np.linalg.norm(rays, axis=1) >= LEAST_DESCENT).all(axis=2)
    flat = sizes - 1.5 * np.log(np.maximum(descents, 1e-6))
    off = (flat - np.median(flat, axis=2, keepdims=True)) / _LOG_SD
    logs = -(_FREEDOM + 1) / 2 * np.log1p(off**2 / _FREEDOM).sum(axis=2)
    return np.asarray(np.where(seen, logs, -math.inf))
