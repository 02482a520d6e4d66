"""Tilt of the camera: its value, its ground plane, its record, and the lengths of cars under it.

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
from vehanchor.imagery.metadata.lens import (
    equivalent_lens,
    lens,
    perspective_problem,
    taken_ratio,
)
from vehanchor.records import Notice, TiltEstimate
from vehanchor.records.notices import NoticeCode
from vehanchor.scale.defaults import PROBABLY_RIGHT
from vehanchor.scale.lengths import Z95
from vehanchor.scale.plane import GroundPlane
from vehanchor.scale.reliability import chance_of_tilt

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.detection.detections import Detections
    from vehanchor.detection.detector_errors import DetectorErrors
    from vehanchor.imagery.facts import ImageFacts
    from vehanchor.options import ScaleOptions
    from vehanchor.records import GsdEstimate, KnownPlane

    Boxes: TypeAlias = NDArray[np.float64]
    """``[n, 5]`` rows ``(x, y, length, width, angle)``, pixels and radians."""

    Points: TypeAlias = NDArray[np.float64]
    """``[n, 2]`` x, y in focal lengths from the image's centre."""

    Lengths: TypeAlias = NDArray[np.float64]
    """``[n]`` lengths, or logs of them."""

    Slopes: TypeAlias = NDArray[np.float64]
    """``[2]`` slopes along x and y."""

    Covariance: TypeAlias = NDArray[np.float64]
    """``[2, 2]`` covariance of slopes."""

# An image with a smaller tilt counts as taken at nadir.
NADIR_TOLERANCE_DEG = 10.0
# Error of a gimbal's angle, and of nearly level ground.
TILT_SD_DEG = 1.5
# 35 mm equivalent focal length of most drones' cameras.
_USUAL_FOCAL_35MM = 26.0

# Fit of the tilt to the sizes of cars.
MIN_CARS = 12
_MIN_SCORE = 0.5
# Largest ratio of a car's length to the median, in either direction.
_MAX_RATIO = 4.0
# Neighbours are alike: this share of the cars counts, and at most this number. A choice.
_INDEPENDENT_SHARE = 0.5
_MAX_INDEPENDENT = 40.0
# Weak information on all parameters: cars in a row determine no slope across the row.
_WEAK_INFORMATION = 1e-6 * np.eye(3)
# Steps of the reweighted fit, after which no digit in messages changes. ``scipy.optimize`` would
# take 0.2 s to load.
_N_STEPS = 30
# Standard deviations of a one-sided limit that holds in 99 of 100 cases.
_SURE_SDS = 2.33
# d log(square root of a car's area) / d tan(tilt): the GSD of ``vehanchor.scale.plane`` has the
# exponent -1.5.
_EXPONENT = 1.5

# Chance of a tilt by few cars: a camera on a pole looks ahead, with the far cars above.
_UPRIGHT_TILTS_DEG = np.arange(25.0, 61.0, 5.0)
# Spread of the log sizes of few cars over that of one fleet, and the share of other vehicles and
# their spread. Choices.
_FEW_CARS_SPREAD = 1.2
_OTHERS_SHARE = 0.05
_OTHERS_LOG_SD = 0.45
# Least score: two boxes, one of them no car, are of different sizes, as two cars seen at a tilt.
_MIN_SCORE_OF_FEW = 0.7
# Fewest and most cars for it; more tell every tilt.
_FEW_CARS = (2, 2 * MIN_CARS)
# Log sizes of the image's centre, relative to the median car.
_CENTRE_LOG_SIZES = np.arange(-1.5, 1.5, 0.02)
# Least share of the scale at the image's centre: rows at the horizon have none.
_MIN_NEARNESS = 0.05

# Lengths of cars under a tilt.
# Share of the width in the log of a length; on the train split 0.2 to 0.3 do alike at 30 and 45
# degrees.
_WIDTH_SHARE = 0.25


class CameraTilt(NamedTuple):
    """Tilt of a camera that was not at nadir.

    Attributes:
        tilt_deg: angle between the camera's axis and straight down.
        roll_deg: direction of the tilt in the image, clockwise from its upper side.
        focal_length_px: pixels of the image.
        source: of the angle, in words.
    """

    tilt_deg: float
    roll_deg: float
    focal_length_px: float
    source: str

    def plane(self, image: ImageFacts, gsd_m_per_px: float = 1.0) -> GroundPlane:
        """Make the ground plane of an image, with a scale at its centre."""
        return ground_plane(
            self,
            image.width_px,
            height_px=image.height_px,
            gsd_m_per_px=gsd_m_per_px,
        )

    def record(self, image: ImageFacts, gsd_m_per_px: float | None) -> TiltEstimate:
        """Make the record of the tilt, with the range of scales if that of the centre is known."""
        smallest = largest = None
        if gsd_m_per_px is not None:
            smallest, largest = self.plane(image, gsd_m_per_px).gsd_range
        reach_deg = Z95 * TILT_SD_DEG
        return TiltEstimate(
            tilt_deg=self.tilt_deg,
            tilt_ci95_low_deg=max(0.0, self.tilt_deg - reach_deg),
            tilt_ci95_high_deg=min(90.0, self.tilt_deg + reach_deg),
            roll_deg=self.roll_deg,
            focal_length_px=self.focal_length_px,
            source=self.source,
            gsd_least_m_per_px=smallest,
            gsd_largest_m_per_px=largest,
        )


def metadata_tilt(image: ImageFacts, options: ScaleOptions) -> CameraTilt | None:
    """Read the tilt from the metadata.

    Args:
        image: facts of the image, with its camera.
        options: whether the metadata may be used.

    Returns:
        The tilt; None up to ten degrees, without an angle, and for a crop. If the focal length is
        unknown, that of most drones is assumed, and the source says so.

    Raises:
        TooObliqueError: the horizon is in the image or close to it.
    """
    camera = image.camera
    if not options.rulers.metadata:
        return None
    if camera is None or camera.off_nadir_deg is None:
        return None
    if camera.off_nadir_deg <= NADIR_TOLERANCE_DEG:
        return None
    if taken_ratio(image, camera) is None or perspective_problem(image, camera):
        return None
    focal_px, focal_is_known = focal_length(image, options)
    source = "metadata"
    if not focal_is_known:
        source = "metadata; focal length unknown"
    tilt = CameraTilt(
        camera.off_nadir_deg,
        camera.roll_deg or 0.0,
        focal_length_px=focal_px,
        source=source,
    )
    try:
        tilt.plane(image).check()
    except TooObliqueError as error:
        remedy = (
            "If the metadata are wrong, leave them out: --no-metadata, metadata=False, or "
            "metadata: false in a tool"
        )
        raise TooObliqueError(f"by the metadata, {error}. {remedy}") from None
    return tilt


def focal_length(image: ImageFacts, options: ScaleOptions) -> tuple[float, bool]:
    """Take the focal length from the caller or the metadata, else assume that of most drones.

    Args:
        image: size and camera of the image.
        options: the caller's focal length, and whether the metadata may be used.

    Returns:
        Pixels of the image, and whether it is known.
    """
    camera = image.camera if options.rulers.metadata else None
    optics = lens(image, camera, options.rulers.focal_35mm)
    if optics is not None:
        return optics.pixels, True
    usual = equivalent_lens(*image.photograph_size_px, _USUAL_FOCAL_35MM)
    return usual.pixels, False


def with_scale(tilt: TiltEstimate, record: GsdEstimate, gsd_m_per_px: float | None) -> TiltEstimate:
    """Recalculate the range of scales of a tilt for another scale at the centre.

    Args:
        tilt: tilt of an image.
        record: record of that image.
        gsd_m_per_px: the other scale; None for no scale.
    """
    smallest = largest = None
    if gsd_m_per_px is not None:
        plane = ground_plane(
            tilt,
            record.image_width_px,
            height_px=record.image_height_px,
            gsd_m_per_px=gsd_m_per_px,
        )
        smallest, largest = plane.gsd_range
    scales = {"gsd_least_m_per_px": smallest, "gsd_largest_m_per_px": largest}
    return tilt.model_copy(update=scales)


def ground_plane(
    tilt: CameraTilt | TiltEstimate | KnownPlane, width_px: int, height_px: int, gsd_m_per_px: float
) -> GroundPlane:
    """Make the ground plane of an image of this size, with a scale at its centre."""
    return GroundPlane(
        gsd_m_per_px,
        tilt.tilt_deg,
        focal_px=tilt.focal_length_px,
        width_px=width_px,
        height_px=height_px,
        roll_deg=tilt.roll_deg,
    )


def suspected_tilt(
    detections: Detections, width_px: int, height_px: int, *, focal_px: float, log_size_sd: float
) -> float | None:
    """Estimate the tilt from the trend of the cars' sizes over the image.

    Of eight photographs with a known tilt this names the three with 41 to 58 degrees that show 12
    cars and more; of 329 at nadir it names none.

    Args:
        detections: vehicles in pixels of the image.
        width_px: width of the image.
        height_px: height of the image.
        focal_px: focal length, pixels.
        log_size_sd: spread of the log of the square root of box areas within one fleet.

    Returns:
        The tilt that explains the trend, in degrees; None unless more than ten degrees are nearly
        certain, and for fewer than 12 certain cars that lie completely in the image.
    """
    boxes = _whole_cars(detections, width_px, height_px, min_score=_MIN_SCORE)
    if len(boxes) < MIN_CARS:
        return None
    # Log of the square root of a box's area, over its place in focal lengths from the centre.
    centre = [width_px / 2, height_px / 2]
    places = (boxes[:, :2] - centre) / focal_px
    areas = boxes[:, 2] * boxes[:, 3]
    log_sizes = np.log(areas) / 2
    slopes, covariance = _fitted_slopes(places, log_sizes, log_size_sd)

    slope = float(np.hypot(*slopes))
    direction = np.array([1.0, 0.0])
    if slope > 0:
        direction = slopes / slope
    variance = direction @ covariance @ direction
    slope_sd = float(np.sqrt(variance))
    least_slope = slope - _SURE_SDS * slope_sd
    nadir_slope = _EXPONENT * math.tan(math.radians(NADIR_TOLERANCE_DEG))
    if least_slope <= nadir_slope:
        return None
    return math.degrees(math.atan(slope / _EXPONENT))


def _fitted_slopes(places: Points, log_sizes: Lengths, log_sd: float) -> tuple[Slopes, Covariance]:
    """Fit log sizes by a plane over the image; Cauchy's loss makes it robust against lorries.

    Args:
        places: ``[n, 2]`` places of cars.
        log_sizes: ``[n]``.
        log_sd: spread of the log sizes around the plane.

    Returns:
        ``[2]`` slopes of the plane, and their covariance ``[2, 2]``.
    """
    n_cars = len(places)
    design = np.column_stack([np.ones(n_cars), places])
    plane = np.array([np.median(log_sizes), 0.0, 0.0])
    information = np.eye(3)
    # Iterated least squares: the weights of Cauchy's loss follow from the last fit.
    for _ in range(_N_STEPS):
        deviations = (design @ plane - log_sizes) / log_sd
        weights = 1.0 / (1.0 + deviations**2)
        weighted_design = design * weights[:, None]
        information = design.T @ weighted_design + _WEAK_INFORMATION
        moments = design.T @ (weights * log_sizes)
        plane = np.linalg.solve(information, moments)
    independent_share = min(_INDEPENDENT_SHARE, _MAX_INDEPENDENT / n_cars)
    variance = log_sd**2 / independent_share
    covariance = variance * np.linalg.inv(information)
    slopes = np.asarray(plane[1:])
    return slopes, np.asarray(covariance[1:, 1:])


class _UprightTilt(NamedTuple):
    """Tilt of a camera that looks ahead, with the far cars above.

    Attributes:
        tilt_deg: most likely angle between its axis and straight down.
        log_odds: log of the likelihood of all such tilts over that of an image at nadir.
    """

    tilt_deg: float
    log_odds: float


def _upright_tilt(
    detections: Detections, image: ImageFacts, *, focal_px: float, log_size_sd: float
) -> _UprightTilt | None:
    """Weigh tilts from 25 to 60 degrees, all equally likely, by the sizes of cars.

    Args:
        detections: vehicles in pixels of the image.
        image: size of the image.
        focal_px: focal length, pixels.
        log_size_sd: as in ``suspected_tilt``.

    Returns:
        None for fewer than two cars, and for many.
    """
    height_px = image.height_px
    boxes = _whole_cars(detections, image.width_px, height_px, min_score=_MIN_SCORE_OF_FEW)
    fewest, most = _FEW_CARS
    if not fewest <= len(boxes) <= most:
        return None
    places = (boxes[:, 1] - height_px / 2) / focal_px
    areas = boxes[:, 2] * boxes[:, 3]
    log_sizes = np.log(areas) / 2
    log_sizes -= np.median(log_sizes)
    log_sd = _FEW_CARS_SPREAD * log_size_sd
    at_nadir = _log_likelihood(log_sizes, log_sd)
    log_odds = []
    for tilt in np.radians(_UPRIGHT_TILTS_DEG):
        # Sizes follow the nearness of the ground below a row, with the exponent of the GSD.
        nearness = np.maximum(1.0 + places * math.tan(tilt), _MIN_NEARNESS)
        expected = _EXPONENT * np.log(nearness)
        of_level_ground = log_sizes - expected + expected.mean()
        log_odds.append(_log_likelihood(of_level_ground, log_sd) - at_nadir)
    likeliest = int(np.argmax(log_odds))
    of_all = float(np.logaddexp.reduce(log_odds)) - math.log(len(log_odds))
    return _UprightTilt(float(_UPRIGHT_TILTS_DEG[likeliest]), of_all)


def _log_likelihood(log_sizes: Lengths, log_sd: float) -> float:
    """Compute the log likelihood of sizes that scatter around an unknown common one.

    Args:
        log_sizes: ``[n]``, relative to about the median.
        log_sd: spread of cars; other vehicles spread more.
    """
    deviations = log_sizes[:, None] - _CENTRE_LOG_SIZES
    cars = np.exp(-0.5 * (deviations / log_sd) ** 2) / log_sd
    others = np.exp(-0.5 * (deviations / _OTHERS_LOG_SD) ** 2) / _OTHERS_LOG_SD
    logs = np.log((1.0 - _OTHERS_SHARE) * cars + _OTHERS_SHARE * others)
    return float(np.logaddexp.reduce(logs.sum(axis=0)))


class TiltDoubt(NamedTuple):
    """Doubt that a photograph of unknown tilt was taken straight down.

    Attributes:
        notices: a warning, or none.
        chance: 0..1, chance by the sizes of few cars that the camera looks ahead; 0 if the tilt is
            known, or if the sizes do not speak for one.
    """

    notices: tuple[Notice, ...] = ()
    chance: float = 0.0


def tilt_doubt(
    image: ImageFacts, options: ScaleOptions, detections: Detections, *, log_size_sd: float
) -> TiltDoubt:
    """Find a tilt that the vehicles' sizes show, or that the metadata state for a crop.

    Many cars can make a tilt nearly certain, and few cars probable.

    Args:
        image: size and metadata of the image.
        options: which metadata may be used.
        detections: vehicles in pixels of the image.
        log_size_sd: as in ``suspected_tilt``.
    """
    camera = image.camera if options.rulers.metadata else None
    if image.georeference_gsd_m_per_px is not None:
        return TiltDoubt()
    if camera is not None and camera.off_nadir_deg is not None:
        at_nadir = camera.off_nadir_deg <= NADIR_TOLERANCE_DEG
        if at_nadir or taken_ratio(image, camera) is not None:
            return TiltDoubt()
        return TiltDoubt((_tilted_crop(camera.off_nadir_deg),))
    focal_px, _ = focal_length(image, options)
    tilt_deg = suspected_tilt(
        detections,
        image.width_px,
        image.height_px,
        focal_px=focal_px,
        log_size_sd=log_size_sd,
    )
    chance = 0.0
    by_few = _upright_tilt(detections, image, focal_px=focal_px, log_size_sd=log_size_sd)
    if by_few is not None:
        chance = chance_of_tilt(by_few.log_odds)
        if tilt_deg is None and chance >= PROBABLY_RIGHT:
            tilt_deg = by_few.tilt_deg
    if tilt_deg is None:
        return TiltDoubt(chance=chance)
    return TiltDoubt((_tilted_by_sizes(tilt_deg),), chance)


def _tilted_crop(tilt_deg: float) -> Notice:
    """Warn that an image is a crop of an oblique photograph, at an unknown place of it."""
    message = (
        f"The metadata state a tilt of {tilt_deg:.0f} degrees, and the image is a crop from an "
        "unknown part of that photograph. It is measured as if taken at nadir: the scale varies "
        "over it, and areas and lengths may be wrong. Give the original file."
    )
    return Notice(code=NoticeCode.TILT_SUSPECTED, message=message)


def _tilted_by_sizes(tilt_deg: float) -> Notice:
    """Warn of a tilt that the sizes of the cars show."""
    message = (
        f"The camera seems to be tilted by about {tilt_deg:.0f} degrees: cars are larger on one "
        "side of the image. The scale varies over the image, and areas and lengths far from its "
        "centre are wrong. Give the original file, whose metadata state the tilt, or a crop around "
        "the object."
    )
    return Notice(code=NoticeCode.TILT_SUSPECTED, message=message)


def _whole_cars(
    detections: Detections, width_px: int, height_px: int, *, min_score: float
) -> Boxes:
    """Select the boxes of likely cars that lie completely in the image."""
    boxes = detections.boxes[detections.scores >= min_score]
    if len(boxes) == 0:
        return boxes
    x = boxes[:, 0]
    y = boxes[:, 1]
    lengths = boxes[:, 2]
    # In whatever direction a car points, it lies within half of its length.
    reach = lengths / 2
    x_inside = (x > reach) & (x < width_px - reach)
    y_inside = (y > reach) & (y < height_px - reach)
    ratios = lengths / np.median(lengths)
    likely = (ratios < _MAX_RATIO) & (ratios > 1 / _MAX_RATIO)
    return np.asarray(boxes[x_inside & y_inside & likely])


def rectified(detections: Detections, plane: GroundPlane, errors: DetectorErrors) -> Detections:
    """Rectify the lengths and widths of vehicles to nadir and to the scale of the image's centre.

    Args:
        detections: in pixels of the image; positions and angles are kept.
        plane: ground plane, with one metre per pixel at the image's centre.
        errors: errors of the detector, with the proportions of its boxes.
    """
    are_bodies = detections.appearance is not None
    proportions = errors.length_over_width(of_bodies=are_bodies)
    long_axis, short_axis = box_axes(detections.boxes)
    lengths = plane.length(*long_axis)
    widths = plane.length(*short_axis)
    boxes = detections.boxes.copy()
    boxes[:, 2] = length_off_nadir(lengths, widths, length_over_width=proportions)
    lengths_at_nadir = boxes[:, 2]
    boxes[:, 3] = lengths_at_nadir / errors.boxes.length_over_width
    return replace(detections, boxes=boxes)


def length_off_nadir(lengths: Lengths, widths: Lengths, *, length_over_width: float) -> Lengths:
    """Combine lengths and widths on the ground to lengths that do not depend on the direction.

    Args:
        lengths: ``[n]`` lengths of boxes.
        widths: ``[n]`` widths of boxes.
        length_over_width: proportions of such boxes at nadir.

    Returns:
        ``[n]`` weighted geometric means of the lengths, and of the lengths that the widths imply.
    """
    implied = length_over_width * widths
    length_share = 1 - _WIDTH_SHARE
    return np.asarray(lengths**length_share * implied**_WIDTH_SHARE)
