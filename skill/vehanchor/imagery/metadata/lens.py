"""The field of view of a camera, from its metadata or a 35 mm equivalent focal length.

Metadata describe the picture as it was taken. For a resized copy the focal length is scaled; a crop
has none.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.imagery.metadata.sensors import sensor_of

if TYPE_CHECKING:
    from vehanchor.imagery.facts import ImageFacts
    from vehanchor.imagery.metadata.camera import CameraMetadata

_FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
# some makers mean the diagonal (CIPA DCG-001), some the width: 4 % apart at 4:3; whole mm
_EQUIVALENT_LOG_SD = 0.04
# length of a sensor's long side over its short one; wider pictures leave rows out
_WIDEST_SENSOR = 1.55
# of a sensor of 4:3 (1.25) or 3:2 (1.202) whose full width a wider picture takes
_DIAGONAL_PER_WIDTH = 1.226
_WIDE_LOG_SD = 0.02
_CALIBRATED_LOG_SD = 0.02
_SENSOR_LOG_SD = 0.03
_TABLE_LOG_SD = 0.02  # root mean square of sixteen such sensors against OpenAthena's calibrations
_CENTRE_TOLERANCE = 0.05


class Lens(NamedTuple):
    """The field of view of an image.

    Attributes:
        pixels: focal length in pixels of the image: height in metres over metres per pixel.
        log_sd: standard deviation of its log.
        source: the data behind it, in words.
    """

    pixels: float
    log_sd: float
    source: str


def taken_ratio(image: ImageFacts, camera: CameraMetadata) -> float | None:
    """Ratio of the picture's size when it was taken to the image's size.

    Args:
        image: its size.
        camera: the size when it was taken.

    Returns:
        Original pixels per pixel of the image; 1 if the original size is unknown, None for a crop.
    """
    if not camera.taken_width_px or not camera.taken_height_px:
        return 1.0
    long = max(image.width_px, image.height_px)
    short = min(image.width_px, image.height_px)
    taken_short, taken_long = sorted((camera.taken_width_px, camera.taken_height_px))
    fitting = taken_short * long / taken_long
    slack = 1.0 + short / long  # one pixel of rounding in either side
    return taken_long / long if abs(short - fitting) <= slack else None


def lens(
    image: ImageFacts, camera: CameraMetadata | None, given_35mm: float | None = None
) -> Lens | None:
    """Read the focal length from the most exact of the metadata; its spread grows if they contradict each other.

    Args:
        image: its size.
        camera: its metadata.
        given_35mm: the caller's 35 mm equivalent focal length, millimetres, in place of the
            metadata.

    Returns:
        None without a focal length, or for a crop.
    """
    if given_35mm is not None:
        return equivalent_lens(image.width_px, image.height_px, given_35mm)
    ratio = None if camera is None else taken_ratio(image, camera)
    if camera is None or ratio is None:
        return None
    known = []
    sized = camera.taken_width_px is not None
    if camera.focal_px and camera.focal_px > 0 and _centred(image, camera):
        source = f"a calibrated focal length of {camera.focal_px:g} px"
        known.append(Lens(camera.focal_px / ratio, _CALIBRATED_LOG_SD, source))
    sensor = sensor_of(camera.make, camera.model)
    focal_mm = None if sensor is None else sensor.focal_mm(camera.focal_mm)
    if sensor is not None and focal_mm is not None:
        pixels = focal_mm / sensor.pixel_mm(image.width_px, image.height_px)
        source = (
            f"{focal_mm:g} mm over the {sensor.width_mm:g} mm wide sensor of the {camera.model}"
        )
        known.append(Lens(pixels, _TABLE_LOG_SD, source))
    if camera.focal_mm and camera.focal_mm > 0 and camera.pixel_mm and sized:
        source = f"{camera.focal_mm:g} mm on pixels of {1000 * camera.pixel_mm:.3g} um"
        known.append(Lens(camera.focal_mm / camera.pixel_mm / ratio, _SENSOR_LOG_SD, source))
    if camera.focal_35mm and camera.focal_35mm > 0:
        known.append(equivalent_lens(image.width_px, image.height_px, camera.focal_35mm))
    if not known:
        return None
    apart = max(abs(math.log(known[0].pixels / other.pixels)) for other in known)
    return known[0]._replace(log_sd=math.hypot(known[0].log_sd, apart / 2))


def equivalent_lens(width_px: int, height_px: int, focal_35mm: float) -> Lens:
    """Convert a 35 mm equivalent focal length, by the diagonal of the sensor.

    Args:
        width_px: of the whole picture.
        height_px: of it.
        focal_35mm: millimetres.
    """
    long = max(width_px, height_px)
    short = min(width_px, height_px)
    wide = long / short > _WIDEST_SENSOR
    diagonal = long * _DIAGONAL_PER_WIDTH if wide else math.hypot(long, short)
    spread = math.hypot(_EQUIVALENT_LOG_SD, _WIDE_LOG_SD if wide else 0.0)
    return Lens(
        focal_35mm * diagonal / _FILM_DIAGONAL_MM, spread, f"{focal_35mm:g} mm (35 mm equivalent)"
    )


def _centred(image: ImageFacts, camera: CameraMetadata) -> bool:
    """Whether a calibrated optical centre lies in the middle of the stated size: then both mean the same picture."""
    if camera.centre_x_px is None:
        return camera.taken_width_px is not None
    widths = (
        (camera.taken_width_px,) if camera.taken_width_px else (image.width_px, image.height_px)
    )
    return any(abs(2 * camera.centre_x_px / width - 1) <= _CENTRE_TOLERANCE for width in widths)
