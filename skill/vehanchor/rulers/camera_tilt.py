"""Tilt of the camera: its value, the ground plane that it implies, its form in records, and vehicles at nadir.

In a tilted view nearer cars are longer than farther ones, and cars that point away are
foreshortened. A detector trained on nadir images still draws boxes with a car's proportions. On the
ground plane a car that points away is therefore too long and too narrow; a car across the view is
too short and too wide. Three quarters of the log length plus one quarter of the log width do not
depend on the car's direction.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.detection.boxes import box_axes
from vehanchor.errors import TooObliqueError
from vehanchor.imagery.metadata.lens import equivalent_lens, lens, taken_ratio
from vehanchor.records import Notice, TiltEstimate
from vehanchor.records.notices import NoticeCode
from vehanchor.scale.defaults import CAR_LENGTH_OVER_WIDTH
from vehanchor.scale.lengths import Z95
from vehanchor.scale.plane import GroundPlane

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.detection.detections import Detections
    from vehanchor.imagery.facts import ImageFacts
    from vehanchor.options import ScaleOptions
    from vehanchor.records import GsdEstimate, KnownPlane

NADIR_TOLERANCE_DEG = 10.0  # an image with a smaller tilt counts as taken at nadir
TILT_SD_DEG = 1.5  # of a gimbal's angle and of nearly level ground
_USUAL_FOCAL_35MM = 26.0  # of drones' cameras
LEAST_CARS = 12
_LEAST_SCORE = 0.5
_LOG_SD = 0.11  # of the square root of box areas within one fleet
_FACTOR = 4.0  # largest ratio of a car's length to the median, in either direction
# share and number of cars that count: neighbours are alike; a choice
_INDEPENDENT = 0.5
_MOST_INDEPENDENT = 40.0
_LITTLE = 1e-6 * np.eye(3)  # information: cars in a row say little
# of the reweighted fit, which then changes no digit that is shown; ``scipy.optimize`` loads for 0.2
# s
_STEPS = 30
_SURE_SDS = 2.33  # 99 of 100
# d log(square root of a car's area) / d tan(tilt): the inverse of ``vehanchor.scale.plane``'s
# pixels
_EXPONENT = 1.5
_BODY_LENGTH_OVER_WIDTH = 2.6  # at nadir; medians of seven places go from 2.47 to 2.65
# share of the width in the log of a length: 0.2 to 0.3 do alike at 30 and 45 degrees, train split
_BY_WIDTH = 0.25


class CameraTilt(NamedTuple):
    """Tilt of a camera that was not at nadir.

    Attributes:
        tilt_deg: angle between its axis and straight down.
        roll_deg: direction of the tilt in the image, clockwise from its upper side.
        focal_length_px: pixels of the image.
        source: of the angle, in words.
    """

    tilt_deg: float
    roll_deg: float
    focal_length_px: float
    source: str

    def plane(self, image: ImageFacts, gsd_m_per_px: float = 1.0) -> GroundPlane:
        """Ground plane of an image, with a scale at its centre."""
        return ground_plane(
            self, image.width_px, height_px=image.height_px, gsd_m_per_px=gsd_m_per_px
        )

    def record(self, image: ImageFacts, gsd_m_per_px: float | None) -> TiltEstimate:
        """Tilt as records show it, with the range of scales if the scale at the centre is known."""
        least, largest = (
            (None, None) if gsd_m_per_px is None else self.plane(image, gsd_m_per_px).gsd_range
        )
        reach = Z95 * TILT_SD_DEG
        return TiltEstimate(
            tilt_deg=self.tilt_deg,
            tilt_ci95_low_deg=max(0.0, self.tilt_deg - reach),
            tilt_ci95_high_deg=min(90.0, self.tilt_deg + reach),
            roll_deg=self.roll_deg,
            focal_length_px=self.focal_length_px,
            source=self.source,
            gsd_least_m_per_px=least,
            gsd_largest_m_per_px=largest,
        )


def metadata_tilt(image: ImageFacts, options: ScaleOptions) -> CameraTilt | None:
    """Read the tilt from the metadata.

    Args:
        image: with its camera.
        options: whether the metadata may be used.

    Returns:
        None up to ten degrees, without an angle, and for a crop. If the focal length is unknown,
        that of most drones is assumed, and the source says so.

    Raises:
        TooObliqueError: the horizon is in the image or close to it.
    """
    camera = image.camera
    if camera is None or camera.off_nadir_deg is None or not options.rulers.metadata:
        return None
    if camera.off_nadir_deg <= NADIR_TOLERANCE_DEG or taken_ratio(image, camera) is None:
        return None
    focal_px, known = focal_length(image, options)
    source = "metadata" if known else "metadata; focal length unknown"
    found = CameraTilt(
        camera.off_nadir_deg, camera.roll_deg or 0.0, focal_length_px=focal_px, source=source
    )
    try:
        found.plane(image).check()
    except TooObliqueError as error:
        remedy = (
            "If the metadata are wrong, leave them out: --no-metadata, metadata=False, or "
            "metadata: false in a tool"
        )
        raise TooObliqueError(f"by the metadata, {error}. {remedy}") from None
    return found


def focal_length(image: ImageFacts, options: ScaleOptions) -> tuple[float, bool]:
    """Take the focal length from the caller or the metadata; without either, assume that of most drones.

    Args:
        image: size and camera of the image.
        options: the caller's focal length, and whether the metadata may be used.

    Returns:
        Pixels of the image, and whether it is known.
    """
    seen = lens(image, image.camera if options.rulers.metadata else None, options.rulers.focal_35mm)
    if seen is None:
        return equivalent_lens(image.width_px, image.height_px, _USUAL_FOCAL_35MM).pixels, False
    return seen.pixels, True


def with_scale(tilt: TiltEstimate, record: GsdEstimate, gsd_m_per_px: float | None) -> TiltEstimate:
    """Recalculate the range of scales of a tilt for another scale at the centre.

    Args:
        tilt: of an image.
        record: of that image.
        gsd_m_per_px: the other scale; None for none.
    """
    least = largest = None
    if gsd_m_per_px is not None:
        least, largest = ground_plane(
            tilt, record.image_width_px, height_px=record.image_height_px, gsd_m_per_px=gsd_m_per_px
        ).gsd_range
    return tilt.model_copy(update={"gsd_least_m_per_px": least, "gsd_largest_m_per_px": largest})


def ground_plane(
    tilt: CameraTilt | TiltEstimate | KnownPlane, width_px: int, height_px: int, gsd_m_per_px: float
) -> GroundPlane:
    """Ground plane of an image of this size, with a scale at its centre."""
    return GroundPlane(
        gsd_m_per_px,
        tilt.tilt_deg,
        focal_px=tilt.focal_length_px,
        width_px=width_px,
        height_px=height_px,
        roll_deg=tilt.roll_deg,
    )


def suspected_tilt(
    detections: Detections, width_px: int, height_px: int, focal_px: float
) -> float | None:
    """Fit the log sizes of cars by a plane over the image, robust against lorries (Cauchy's loss).

    Of eight photographs with a known tilt this names the three with 41 to 58 degrees that show 12
    cars and more; of 329 at nadir it names none.

    Args:
        detections: vehicles in pixels of the image.
        width_px: of the image.
        height_px: of the image.
        focal_px: focal length, pixels.

    Returns:
        The tilt that explains the trend of the sizes, in degrees; None unless more than ten degrees
        are nearly certain, and for fewer than 12 certain cars that lie completely in the image.
    """
    boxes = _whole_cars(detections, width_px, height_px)
    if len(boxes) < LEAST_CARS:
        return None
    places = (boxes[:, :2] - [width_px / 2, height_px / 2]) / focal_px
    design = np.column_stack([np.ones(len(boxes)), places])
    sizes = np.log(boxes[:, 2] * boxes[:, 3]) / 2
    plane = np.array([np.median(sizes), 0.0, 0.0])
    information = np.eye(3)
    for _ in range(_STEPS):
        weights = 1.0 / (1.0 + ((design @ plane - sizes) / _LOG_SD) ** 2)
        information = design.T @ (design * weights[:, None]) + _LITTLE
        plane = np.linalg.solve(information, design.T @ (weights * sizes))
    counted = min(_INDEPENDENT, _MOST_INDEPENDENT / len(boxes))
    covariance = _LOG_SD**2 / counted * np.linalg.inv(information)[1:, 1:]
    slope = float(np.hypot(*plane[1:]))  # of the log size per focal length
    along = plane[1:] / slope if slope > 0 else np.array([1.0, 0.0])
    least = slope - _SURE_SDS * float(np.sqrt(along @ covariance @ along))
    if least <= _EXPONENT * math.tan(math.radians(NADIR_TOLERANCE_DEG)):
        return None
    return math.degrees(math.atan(slope / _EXPONENT))


def tilt_notice(
    image: ImageFacts, options: ScaleOptions, detections: Detections
) -> tuple[Notice, ...]:
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
        if camera.off_nadir_deg <= NADIR_TOLERANCE_DEG or taken_ratio(image, camera) is not None:
            return ()
        message = (
            f"By its metadata the camera was tilted by {camera.off_nadir_deg:.0f} degrees, and "
            "the image is a crop at "
            "an unknown place of that picture. It is measured as if taken at nadir: scales "
            "differ over it, and areas "
            "and lengths may be wrong. Give the original file."
        )
        return (Notice(code=NoticeCode.TILT_SUSPECTED, message=message),)
    tilt_deg = suspected_tilt(
        detections,
        image.width_px,
        height_px=image.height_px,
        focal_px=focal_length(image, options)[0],
    )
    if tilt_deg is None:
        return ()
    message = (
        f"The camera seems to be tilted by about {tilt_deg:.0f} degrees: cars are larger on one "
        "side of the image. "
        "Scales differ over the image, and areas and lengths far from its centre are wrong. "
        "Give the "
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


def rectified(detections: Detections, plane: GroundPlane) -> Detections:
    """Rectify the lengths and widths of vehicles to nadir and to the scale of the image's centre.

    Args:
        detections: in pixels of the image; positions and angles are kept.
        plane: ground plane, with one metre per pixel at the image's centre.
    """
    lengths, widths = (plane.length(*ends) for ends in box_axes(detections.boxes))
    measured = detections.boxes.copy()
    measured[:, 2] = length_off_nadir(lengths, widths, bodies=detections.appearance is not None)
    measured[:, 3] = measured[:, 2] / CAR_LENGTH_OVER_WIDTH
    return replace(detections, boxes=measured)


def length_off_nadir(
    lengths: NDArray[np.float64], widths: NDArray[np.float64], *, bodies: bool
) -> NDArray[np.float64]:
    """Combine lengths and widths ``[n]`` on the ground to lengths that do not depend on the car's direction.

    Args:
        lengths: of boxes.
        widths: of boxes.
        bodies: whether these are the boxes of bodies, as the chip network measures them.
    """
    proportion = _BODY_LENGTH_OVER_WIDTH if bodies else CAR_LENGTH_OVER_WIDTH
    return np.asarray(lengths ** (1 - _BY_WIDTH) * (proportion * widths) ** _BY_WIDTH)
