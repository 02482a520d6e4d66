"""Where the camera looked, and what that does to lengths: vehicles are measured on the plane of the ground.

Beyond ten degrees from straight down nearer cars are longer in the image than farther ones, and those that point away
are foreshortened. A detector that has learned cars from above draws boxes of a car's proportions all the same: laid on
the ground, a car that points away comes out too long and too narrow, one across the view too short and too wide. Three
quarters of the one and a quarter of the other is a length that stays the same whichever way the car stands.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.records import KnownPlane, TiltEstimate
from vehanchor.rulers.camera import MAX_OFF_NADIR_DEG, TILT_SD_DEG, taken_ratio
from vehanchor.scale.lengths import Z95
from vehanchor.scale.plane import GroundPlane
from vehanchor.tilt.vehicle_cue import focal_of

if TYPE_CHECKING:
    from vehanchor.detection.detections import Detections
    from vehanchor.options import ScaleOptions
    from vehanchor.records import GsdEstimate
    from vehanchor.rulers.evidence import ImageFacts

_BY_WIDTH = 0.25  # share of the width in the log of a length: 0.2 to 0.3 do alike at 30 and 45 degrees, train split
_LENGTH_OVER_WIDTH = 2.21  # of the detector's boxes from above


class CameraTilt(NamedTuple):
    """A camera that looked aside.

    Attributes:
        tilt_deg: angle between its axis and straight down.
        roll_deg: by which the direction in which it looks aside is turned clockwise from the image's upper side.
        focal_px: focal length, pixels of the image.
        source: where the tilt is from, as words.
        interval_deg: 95 % interval of the tilt; None for that of a gimbal.
    """

    tilt_deg: float
    roll_deg: float
    focal_px: float
    source: str
    interval_deg: tuple[float, float] | None = None


def metadata_tilt(image: ImageFacts, options: ScaleOptions) -> CameraTilt | None:
    """Read from the metadata where the camera looked.

    Args:
        image: with its camera.
        options: whether metadata are to be read.

    Returns:
        None where it looked down to ten degrees, or does not say, or is a crop. Without a lens the focal length is that
        of most drones, and the source says so.

    Raises:
        TooObliqueError: the horizon is in sight, or nearly so.
    """
    camera = image.camera
    if camera is None or camera.off_nadir_deg is None or not options.rulers.metadata:
        return None
    if camera.off_nadir_deg <= MAX_OFF_NADIR_DEG or taken_ratio(image, camera) is None:
        return None
    focal = focal_of(image, options)
    found = CameraTilt(camera.off_nadir_deg, camera.roll_deg or 0.0, focal.pixels, f"metadata{focal.doubt}")
    plane_with(found, image, 1.0).check()
    return found


def plane_with(looked: CameraTilt, image: ImageFacts, gsd_m_per_px: float) -> GroundPlane:
    """The plane with a scale at the centre."""
    return GroundPlane(gsd_m_per_px, looked.tilt_deg, looked.focal_px, image.width_px, image.height_px, looked.roll_deg)


def rectified(detections: Detections, looked: CameraTilt, image: ImageFacts) -> Detections:
    """Vehicles as long as they would be at the image's centre, seen from straight above at the centre's scale.

    Args:
        detections: in pixels of the image.
        looked: where the camera looked.
        image: its size.

    Returns:
        The same, with other lengths and widths; without what a network says of the ground, which was shown no such
        view.
    """
    plane = plane_with(looked, image, 1.0)
    boxes = detections.boxes
    along = np.column_stack([np.cos(boxes[:, 4]), np.sin(boxes[:, 4])])
    across = np.column_stack([-along[:, 1], along[:, 0]])
    sides = []
    for column, direction in ((2, along), (3, across)):
        reach = direction * boxes[:, column : column + 1] / 2
        sides.append(plane.length(boxes[:, :2] - reach, boxes[:, :2] + reach))
    measured = boxes.copy()
    measured[:, 2] = sides[0] ** (1 - _BY_WIDTH) * (_LENGTH_OVER_WIDTH * sides[1]) ** _BY_WIDTH
    measured[:, 3] = measured[:, 2] / _LENGTH_OVER_WIDTH
    return replace(detections, boxes=measured, scene=None)


def known_plane(tilt_deg: float, roll_deg: float, focal_px: float) -> KnownPlane:
    """Where a camera looked, as a scale that is given back has it."""
    return KnownPlane(tilt_deg=tilt_deg, roll_deg=roll_deg, focal_length_px=focal_px)


def plane_of_record(record: GsdEstimate) -> GroundPlane | None:
    """The plane of an image whose scale was estimated; None where the camera looked down, or there is no scale."""
    tilt, gsd = record.tilt, record.gsd_m_per_px
    if tilt is None or gsd is None:
        return None
    size = record.image_width_px, record.image_height_px
    return GroundPlane(gsd, tilt.tilt_deg, tilt.focal_length_px, *size, tilt.roll_deg)


def tilt_record(looked: CameraTilt, image: ImageFacts, gsd_m_per_px: float | None) -> TiltEstimate:
    """The tilt as records tell it."""
    least, largest = (None, None) if gsd_m_per_px is None else plane_with(looked, image, gsd_m_per_px).gsd_range
    reach = Z95 * TILT_SD_DEG
    low, high = looked.interval_deg or (looked.tilt_deg - reach, looked.tilt_deg + reach)
    return TiltEstimate(
        tilt_deg=looked.tilt_deg,
        tilt_ci95_low_deg=max(0.0, low),
        tilt_ci95_high_deg=min(90.0, high),
        roll_deg=looked.roll_deg,
        focal_length_px=looked.focal_px,
        source=looked.source,
        gsd_least_m_per_px=least,
        gsd_largest_m_per_px=largest,
    )


def with_scale(tilt: TiltEstimate, record: GsdEstimate, gsd_m_per_px: float | None) -> TiltEstimate:
    """The same tilt under another scale at the centre.

    Args:
        tilt: of an image.
        record: of that image.
        gsd_m_per_px: the other scale; None for none.
    """
    size = record.image_width_px, record.image_height_px
    least, largest = (
        (None, None)
        if gsd_m_per_px is None
        else GroundPlane(gsd_m_per_px, tilt.tilt_deg, tilt.focal_length_px, *size, tilt.roll_deg).gsd_range
    )
    return tilt.model_copy(update={"gsd_least_m_per_px": least, "gsd_largest_m_per_px": largest})
