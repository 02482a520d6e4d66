"""Field of view of a camera, from its metadata or a 35 mm equivalent focal length.

Metadata describe the picture as it was taken. For a resized copy the focal length is scaled. For a
crop it is unknown.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.imagery.metadata.sensors import sensor_of

if TYPE_CHECKING:
    from vehanchor.imagery.facts import ImageFacts
    from vehanchor.imagery.metadata.camera import CameraMetadata

_FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)

_EQUIVALENT_LOG_SD = 0.04
"""Error of a 35 mm equivalent.

Some makers mean the diagonal (CIPA DCG-001), some the width, which differ by 4 % at 4:3. The number
is rounded to whole millimetres.
"""

_MAX_SENSOR_RATIO = 1.55
"""Largest ratio of a sensor's long side to its short one; wider pictures leave out rows."""

_DIAGONAL_PER_WIDTH = 1.226
"""Ratio of a sensor's diagonal to its width: the mean of 4:3 (1.25) and 3:2 (1.202)."""

_WIDE_LOG_SD = 0.02
"""Error by the unknown shape of the sensor, for a picture that leaves out rows."""

_CALIBRATED_LOG_SD = 0.02
_SENSOR_LOG_SD = 0.03
_TABLE_LOG_SD = 0.02
"""Root mean square of sixteen sensors of the table against OpenAthena's calibrations."""

_CHANCE_WRONG = 0.01
"""Chance that a lens is wrong by its usual sources: a calibration, the table of sensors, a 35 mm
equivalent. A choice."""

_PITCH_CHANCE_WRONG = 0.3
"""Chance that a pixel pitch is wrong for a camera that the table lacks.

Programs that resize a picture keep its pitch and change its sizes. A choice: such a lens alone
makes no scale usable.
"""

_OFF_CENTRE_CHANCE_WRONG = 0.3
"""Chance that a lens is wrong if the calibrated optical centre is not in the middle.

The image is a crop, or a copy of another size; both state the new size. A choice: such a lens alone
makes no scale usable.
"""

_FILM_CHANCE_WRONG = 0.3
"""Chance that the focal length of a film is not that of its frames.

Some modes and the stabiliser use a part of the sensor, and the subtitles state the whole lens. A
choice: such a lens alone makes no scale usable.
"""

_PART_CHANCE_WRONG = 0.3
"""Chance that a focal length is not that of the photograph that was found in a picture.

Plain ground, such as snow, can be taken for a margin, and a page can show a part of a photograph. A
choice: such a lens alone makes no scale usable.
"""

_MAX_CONTRADICTION = 0.15
"""Largest log ratio of two sources that describe one lens: three errors of two equivalents."""

_CENTRE_TOLERANCE = 0.05
"""Distance of an optical centre from the middle, relative to half the width."""

_MAX_DIGITAL_ZOOM = 1.01

_MAX_PICTURE_RATIO = 2.4
"""Largest ratio of a picture's long side to its short one that a camera takes at once: 21:9 of some
phones. A choice."""


class Lens(NamedTuple):
    """Field of view of an image.

    Attributes:
        pixels: focal length in pixels of the image: height in metres over metres per pixel.
        log_sd: standard deviation of its log.
        source: data on which it rests, in words.
        chance_wrong: 0..1, chance that the data belong to another picture.
    """

    pixels: float
    log_sd: float
    source: str
    chance_wrong: float = _CHANCE_WRONG


def perspective_problem(image: ImageFacts, camera: CameraMetadata | None) -> str:
    """Explain why the metadata do not describe the image as one perspective view.

    Args:
        image: size of the image.
        camera: metadata of the image; None if they are not used.

    Returns:
        A clause; empty if the metadata can describe it.
    """
    if camera is None:
        return ""
    if camera.projection:
        return f"the file states {camera.projection}: this is not one perspective view"
    width_px = camera.taken_width_px or image.width_px
    height_px = camera.taken_height_px or image.height_px
    if max(width_px, height_px) > _MAX_PICTURE_RATIO * min(width_px, height_px):
        return (
            f"{width_px} x {height_px} px is a panorama or a crop, because no camera takes such a "
            "picture at once"
        )
    return ""


def zoom_problem(camera: CameraMetadata | None) -> str:
    """Explain why a digital zoom makes the lens unknown: some makers count it in, some do not.

    Returns:
        A clause; empty without a digital zoom.
    """
    if camera is None or camera.digital_zoom <= _MAX_DIGITAL_ZOOM:
        return ""
    return f"the photograph was enlarged {camera.digital_zoom:g} times in the camera"


def taken_ratio(image: ImageFacts, camera: CameraMetadata) -> float | None:
    """Compute the ratio of the picture's size when it was taken to the image's size.

    Args:
        image: size of the image.
        camera: size of the picture when it was taken.

    Returns:
        Original pixels per pixel of the image; 1 if the original size is unknown, None for a crop.
    """
    if camera.crop:
        return None
    if not camera.taken_width_px or not camera.taken_height_px:
        return 1.0
    long_px = max(image.width_px, image.height_px)
    short_px = min(image.width_px, image.height_px)
    taken_short_px, taken_long_px = sorted((camera.taken_width_px, camera.taken_height_px))
    # A resized copy keeps the shape of the original, up to one pixel of rounding in either side.
    expected_short_px = taken_short_px * long_px / taken_long_px
    tolerance_px = 1.0 + short_px / long_px
    if abs(short_px - expected_short_px) > tolerance_px:
        return None
    return taken_long_px / long_px


def lens(
    image: ImageFacts, camera: CameraMetadata | None, focal_35mm: float | None = None
) -> Lens | None:
    """Compute the field of view from the most exact of the metadata.

    Its error grows if the metadata contradict each other.

    Args:
        image: size of the image.
        camera: metadata of the image.
        focal_35mm: the caller's 35 mm equivalent focal length, millimetres, in place of the
            metadata.

    Returns:
        None without a focal length, for a crop, and with a digital zoom.
    """
    if focal_35mm is None and zoom_problem(camera):
        return None
    return lens_without_zoom(image, camera, focal_35mm)


def lens_without_zoom(
    image: ImageFacts, camera: CameraMetadata | None, focal_35mm: float | None = None
) -> Lens | None:
    """Compute the field of view as ``lens`` does, as if there were no digital zoom.

    Returns:
        None without a focal length, and for a crop.
    """
    if focal_35mm is not None:
        given = equivalent_lens(*image.photograph_size_px, focal_35mm)
        if image.part is None:
            return given
        return given._replace(chance_wrong=_PART_CHANCE_WRONG)
    if camera is None:
        return None
    ratio = taken_ratio(image, camera)
    if ratio is None:
        return None
    lenses = _lenses_of_metadata(image, camera, ratio)
    if not lenses:
        return None
    # Half of the largest contradiction is a further error. Another source bears out the best one,
    # unless they differ by more than both may err.
    best = lenses[0]
    contradiction = max(abs(math.log(best.pixels / other.pixels)) for other in lenses)
    chance_wrong = best.chance_wrong
    if contradiction <= _MAX_CONTRADICTION:
        chance_wrong = min(source.chance_wrong for source in lenses)
    if camera.centre_x_px is not None and not _is_centred(image, camera):
        chance_wrong = max(chance_wrong, _OFF_CENTRE_CHANCE_WRONG)
    log_sd = math.hypot(best.log_sd, contradiction / 2)
    return best._replace(log_sd=log_sd, chance_wrong=chance_wrong)


def _lenses_of_metadata(image: ImageFacts, camera: CameraMetadata, ratio: float) -> list[Lens]:
    """List the fields of view that metadata state, from the most to the least exact.

    Args:
        image: size of the image.
        camera: metadata of the image.
        ratio: original pixels per pixel of the image.
    """
    lenses = []
    if camera.focal_px and camera.focal_px > 0 and _is_centred(image, camera):
        lenses.append(
            Lens(
                camera.focal_px / ratio,
                _CALIBRATED_LOG_SD,
                f"a calibrated focal length of {camera.focal_px:g} px",
            )
        )
    sensor = sensor_of(camera.make, camera.model)
    if sensor is not None:
        focal_mm = sensor.focal_mm(camera.focal_mm)
        if focal_mm is not None:
            lenses.append(
                Lens(
                    focal_mm / sensor.pixel_mm(image.width_px, image.height_px),
                    _TABLE_LOG_SD,
                    f"{focal_mm:g} mm over the {sensor.width_mm:g} mm wide sensor of the "
                    f"{camera.model}",
                )
            )
    # A pixel pitch belongs to the original size, which must be known.
    has_taken_size = camera.taken_width_px is not None
    if camera.focal_mm and camera.focal_mm > 0 and camera.pixel_mm and has_taken_size:
        lenses.append(
            Lens(
                camera.focal_mm / camera.pixel_mm / ratio,
                _SENSOR_LOG_SD,
                f"{camera.focal_mm:g} mm on pixels of {1000 * camera.pixel_mm:.3g} um",
                chance_wrong=_PITCH_CHANCE_WRONG,
            )
        )
    if camera.focal_35mm and camera.focal_35mm > 0:
        of_camera = equivalent_lens(image.width_px, image.height_px, camera.focal_35mm)
        if camera.is_film:
            of_camera = of_camera._replace(chance_wrong=_FILM_CHANCE_WRONG)
        lenses.append(of_camera)
    return lenses


def equivalent_lens(width_px: int, height_px: int, focal_35mm: float) -> Lens:
    """Convert a 35 mm equivalent focal length, by the diagonal of the sensor.

    Args:
        width_px: width of the whole picture.
        height_px: height of the whole picture.
        focal_35mm: millimetres.
    """
    long_px = max(width_px, height_px)
    short_px = min(width_px, height_px)
    if long_px / short_px > _MAX_SENSOR_RATIO:
        diagonal_px = long_px * _DIAGONAL_PER_WIDTH
        log_sd = math.hypot(_EQUIVALENT_LOG_SD, _WIDE_LOG_SD)
    else:
        diagonal_px = math.hypot(long_px, short_px)
        log_sd = _EQUIVALENT_LOG_SD
    return Lens(
        focal_35mm * diagonal_px / _FILM_DIAGONAL_MM,
        log_sd,
        f"{focal_35mm:g} mm (35 mm equivalent)",
    )


def _is_centred(image: ImageFacts, camera: CameraMetadata) -> bool:
    """Test whether a calibrated optical centre lies in the middle of the stated width.

    If it does, the calibration and the size describe the same picture. Without an original size,
    either side of the image can be the width.
    """
    if camera.centre_x_px is None:
        return camera.taken_width_px is not None
    widths = [image.width_px, image.height_px]
    if camera.taken_width_px:
        widths = [camera.taken_width_px]
    return any(abs(2 * camera.centre_x_px / width - 1) <= _CENTRE_TOLERANCE for width in widths)
