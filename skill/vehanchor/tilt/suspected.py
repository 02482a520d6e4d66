"""Doubt that an image was taken at nadir: cars that are larger on one side, or metadata of a tilted camera."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from vehanchor.imagery.metadata.lens import taken_ratio
from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.tilt.camera_tilt import NADIR_TOLERANCE_DEG, focal_length

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.detection.detections import Detections
    from vehanchor.imagery.facts import ImageFacts
    from vehanchor.options import ScaleOptions

LEAST_CARS = 12
_LEAST_SCORE = 0.5
_LOG_SD = 0.11  # of the square root of box areas within one fleet
_FACTOR = 4.0  # largest ratio of a car's length to the median, in either direction
_INDEPENDENT, _MOST_INDEPENDENT = 0.5, 40.0  # share and number of cars that count: neighbours are alike; a choice
_LEAST_INFORMATION = 1e-6
_SURE_SDS = 2.33  # 99 of 100
_EXPONENT = 1.5  # d log(square root of a car's area) / d tan(tilt): the inverse of ``vehanchor.scale.plane``'s pixels


class SizeTrend(NamedTuple):
    """Change of the cars' sizes over an image, as the tilt that would explain it.

    Attributes:
        slope: change of the log size per focal length.
        slope_sd: its standard deviation.
        n: number of cars.
    """

    slope: float
    slope_sd: float
    n: int

    @property
    def tilt_deg(self) -> float:
        """Tilt of the camera that gives this slope."""
        return math.degrees(math.atan(self.slope / _EXPONENT))

    @property
    def is_tilt(self) -> bool:
        """Whether a tilt above ten degrees is nearly certain."""
        least = _EXPONENT * math.tan(math.radians(NADIR_TOLERANCE_DEG))
        return self.slope - _SURE_SDS * self.slope_sd > least


def size_trend(detections: Detections, width_px: int, height_px: int, focal_px: float) -> SizeTrend | None:
    """Fit the log sizes of cars by a plane over the image, robust against lorries.

    Of eight photographs with a known tilt this names the three with 41 to 58 degrees that show 12 cars and more; of 329
    at nadir it names none.

    Args:
        detections: vehicles in pixels of the image.
        width_px: of the image.
        height_px: of the image.
        focal_px: focal length, pixels.

    Returns:
        None for fewer than 12 certain cars that lie completely in the image.
    """
    boxes = _whole_cars(detections, width_px, height_px)
    if len(boxes) < LEAST_CARS:
        return None
    places = (boxes[:, :2] - [width_px / 2, height_px / 2]) / focal_px
    design = np.column_stack([np.ones(len(boxes)), places])
    sizes = np.log(boxes[:, 2] * boxes[:, 3]) / 2
    fit = least_squares(
        lambda beta: (design @ beta - sizes) / _LOG_SD, [float(np.median(sizes)), 0.0, 0.0], loss="cauchy"
    )
    weights = 1.0 / (1.0 + fit.fun**2)
    counted = min(_INDEPENDENT, _MOST_INDEPENDENT / len(boxes))
    information = design.T @ (design * weights[:, None]) + _LEAST_INFORMATION * np.eye(3)  # cars in a row tell little
    covariance = _LOG_SD**2 / counted * np.linalg.inv(information)[1:, 1:]
    slope = float(np.hypot(*fit.x[1:]))
    along = fit.x[1:] / slope if slope > 0 else np.array([1.0, 0.0])
    return SizeTrend(slope, float(np.sqrt(along @ covariance @ along)), len(boxes))


def tilt_notice(image: ImageFacts, options: ScaleOptions, detections: Detections) -> tuple[Notice, ...]:
    """Warn of a tilt that the vehicles' sizes show, or that the metadata state for a crop.

    Args:
        image: its size and metadata.
        options: which metadata may be used.
        detections: vehicles in pixels of the image.

    Returns:
        One notice, or none.
    """
    camera = image.camera if options.rulers.metadata else None
    if image.georeference_gsd_m_per_px is not None:
        return ()
    if camera is not None and camera.off_nadir_deg is not None:
        tilted = camera.off_nadir_deg > NADIR_TOLERANCE_DEG and taken_ratio(image, camera) is None
        return (_crop_of_tilted(camera.off_nadir_deg),) if tilted else ()
    trend = size_trend(detections, image.width_px, image.height_px, focal_length(image, options)[0])
    if trend is None or not trend.is_tilt:
        return ()
    message = (
        f"The camera seems to be tilted by about {trend.tilt_deg:.0f} degrees: {trend.n} cars are larger on one side "
        "of the image. Scales differ over the image, and areas and lengths far from its centre are wrong. Give the "
        "original file, whose metadata state the tilt, or a crop around the object."
    )
    return (Notice(code=NoticeCode.TILT_SUSPECTED, message=message),)


def _whole_cars(detections: Detections, width_px: int, height_px: int) -> NDArray[np.float64]:
    """Select boxes ``[n, 5]`` of likely cars that lie completely in the image."""
    boxes = detections.boxes[detections.scores >= _LEAST_SCORE]
    if not len(boxes):
        return boxes
    reach = boxes[:, 2] / 2
    inside = (boxes[:, 0] > reach) & (boxes[:, 0] < width_px - reach)
    inside &= (boxes[:, 1] > reach) & (boxes[:, 1] < height_px - reach)
    ratio = boxes[:, 2] / np.median(boxes[:, 2])
    return np.asarray(boxes[inside & (ratio < _FACTOR) & (ratio > 1 / _FACTOR)])


def _crop_of_tilted(off_nadir_deg: float) -> Notice:
    message = (
        f"By its metadata the camera was tilted by {off_nadir_deg:.0f} degrees, and the image is a crop at an unknown "
        "place of that picture. It is measured as if taken at nadir: scales differ over it, and areas and lengths may "
        "be wrong. Give the original file."
    )
    return Notice(code=NoticeCode.TILT_SUSPECTED, message=message)
