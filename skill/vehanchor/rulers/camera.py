"""The camera as a ruler: height above take-off, focal length and sensor, from the metadata in the file.

At the centre of a picture taken straight down a pixel is ``height * pixel pitch / focal length`` wide. Metadata speak
of the picture as it was taken: of a resized copy the pitch is corrected by the ratio of the sizes, a crop is refused.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.evidence import Mark
from vehanchor.rulers.lognormal import lognormal_evidence, no_evidence, on_grid

if TYPE_CHECKING:
    from vehanchor.imagery.metadata.camera import CameraMetadata
    from vehanchor.rulers.evidence import ImageFacts, View
    from vehanchor.rulers.lognormal import LognormalEvidence

_HEIGHT_LOG_SD = 0.12  # ground below is not the ground of the take-off: 10 to 15 %
_HEIGHT_SD_M = 2.0  # barometer and the height of the hand or roof it started from
_MAX_HEIGHT_M = 20_000.0
_UNKNOWN_PITCH_LOG_SD = 0.10
_CHANCE_WRONG, _CHANCE_WRONG_PITCH_UNKNOWN = 0.05, 0.25
MAX_OFF_NADIR_DEG = 10.0  # up to which a picture counts as taken straight down
_MAX_TILT_DEG = 85.0
TILT_SD_DEG = 1.5  # of a gimbal's own angle, and of ground that is not quite level
_MAX_DIGITAL_ZOOM = 1.01

_FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
_EQUIVALENT_LOG_SD = 0.04  # some makers mean the diagonal (CIPA DCG-001), some the width: 4 % apart at 4:3; whole mm
_WIDEST_SENSOR = 1.55  # length of a sensor's long side over its short one; wider pictures leave rows out
_DIAGONAL_PER_WIDTH = 1.226  # of a sensor of 4:3 (1.25) or 3:2 (1.202) whose full width a wider picture takes
_WIDE_LOG_SD = 0.02
_CALIBRATED_LOG_SD, _SENSOR_LOG_SD = 0.02, 0.03
_CENTRE_TOLERANCE = 0.05


class Lens(NamedTuple):
    """How wide a view is.

    Attributes:
        pixels: focal length in pixels of the image as it is: metres of height over metres a pixel.
        log_sd: standard deviation of its log.
        source: what it was taken from, as words.
    """

    pixels: float
    log_sd: float
    source: str


class Camera:
    """What the file says of its camera."""

    kind = "camera"

    def look(self, view: View) -> LognormalEvidence:
        """Measure by the camera's height and lens; nothing where the file does not tell both."""
        camera = view.image.camera
        if camera is None or (camera.height_m is None and not camera.refused):
            return no_evidence(self.kind)
        if camera.height_m is None:
            return self._unusable(f"they were not read: {camera.refused}")
        if not 0 < camera.height_m <= _MAX_HEIGHT_M:
            return self._unusable(f"{camera.height_tag} is {camera.height_m:g} m")
        if camera.digital_zoom > _MAX_DIGITAL_ZOOM:
            return self._unusable(f"the picture was enlarged {camera.digital_zoom:g} times in the camera")
        if taken_ratio(view.image, camera) is None:
            return no_evidence(self.kind, cropped(view.image, camera, "its camera's metadata are no ruler"))
        seen = lens(view.image, camera)
        if seen is None:
            if camera.off_nadir_deg is not None and camera.off_nadir_deg > MAX_OFF_NADIR_DEG:
                return no_evidence(self.kind, _tilted(camera.off_nadir_deg, "and without a focal length"))
            zero = camera.focal_mm is not None and camera.focal_mm <= 0
            return self._unusable("the focal length is 0") if zero else no_evidence(self.kind)
        measured = self._measure(camera, camera.height_m, seen)
        if measured.gsd_m_per_px is None:
            return measured
        return replace(measured, marks=(Mark.of_height(view.image, camera.height_m),))

    def _measure(self, camera: CameraMetadata, height_m: float, seen: Lens) -> LognormalEvidence:
        tilt_deg = camera.off_nadir_deg or 0.0
        tilted = tilt_deg > MAX_OFF_NADIR_DEG
        if tilt_deg >= _MAX_TILT_DEG:
            return no_evidence(self.kind, _tilted(tilt_deg, "so far that"))
        coarser, tilt_log_sd = looking_aside(tilt_deg if tilted else 0.0)
        gsd = height_m / seen.pixels * coarser
        if not on_grid(gsd):
            return self._unusable(f"{height_m:g} m and {seen.source} would make {gsd:.3g} m/px")
        aimed = camera.off_nadir_deg is not None
        log_sd = math.hypot(math.hypot(_HEIGHT_LOG_SD, _HEIGHT_SD_M / height_m), seen.log_sd)
        said = f"The camera's metadata say {{}}: {height_m:g} m ({camera.height_tag}) and {seen.source}."
        if tilted:
            log_sd = math.hypot(log_sd, tilt_log_sd)
            notices = [_tilted(tilt_deg)]
            said += " At the image's centre."
            return lognormal_evidence(self.kind, gsd, log_sd, _CHANCE_WRONG, said, notices=notices)
        if aimed:
            return lognormal_evidence(self.kind, gsd, log_sd, _CHANCE_WRONG, said)
        log_sd = math.hypot(log_sd, _UNKNOWN_PITCH_LOG_SD)
        said += " They do not say where the camera looked: this holds for straight down."
        return lognormal_evidence(self.kind, gsd, log_sd, _CHANCE_WRONG_PITCH_UNKNOWN, said)

    def _unusable(self, why: str) -> LognormalEvidence:
        message = f"The camera's metadata are no ruler: {why}."
        return no_evidence(self.kind, Notice(code=NoticeCode.CAMERA_UNUSABLE, message=message))


def looking_aside(tilt_deg: float) -> tuple[float, float]:
    """What a camera that looked aside does to the scale of the image's centre (``vehanchor.scale.plane``).

    Args:
        tilt_deg: angle between its axis and straight down, below 90.

    Returns:
        By how much the scale is coarser than straight down, and the standard deviation of the log of that.
    """
    tilt = math.radians(tilt_deg)
    return math.cos(tilt) ** -1.5, 1.5 * math.tan(tilt) * math.radians(TILT_SD_DEG)


def taken_ratio(image: ImageFacts, camera: CameraMetadata) -> float | None:
    """Compare the picture as it was taken with the image.

    Args:
        image: its size.
        camera: the size that it had.

    Returns:
        Pixels of the picture as it was taken for each of the image's, 1 where its size is not known; None for a crop.
    """
    if not camera.taken_width_px or not camera.taken_height_px:
        return 1.0
    long, short = max(image.width_px, image.height_px), min(image.width_px, image.height_px)
    taken_short, taken_long = sorted((camera.taken_width_px, camera.taken_height_px))
    fitting = taken_short * long / taken_long
    slack = 1.0 + short / long  # one pixel of rounding in either side
    return taken_long / long if abs(short - fitting) <= slack else None


def lens(image: ImageFacts, camera: CameraMetadata) -> Lens | None:
    """The view of the image, from the best of what the metadata say; wider spread where they contradict each other.

    Args:
        image: its size.
        camera: its metadata.

    Returns:
        None where they do not tell, or for a crop.
    """
    ratio = taken_ratio(image, camera)
    if ratio is None:
        return None
    told = []
    known = camera.taken_width_px is not None
    if camera.focal_px and camera.focal_px > 0 and _centred(image, camera):
        source = f"a calibrated focal length of {camera.focal_px:g} px"
        told.append(Lens(camera.focal_px / ratio, _CALIBRATED_LOG_SD, source))
    if camera.focal_mm and camera.focal_mm > 0 and camera.pixel_mm and known:
        source = f"{camera.focal_mm:g} mm on pixels of {1000 * camera.pixel_mm:.3g} um"
        told.append(Lens(camera.focal_mm / camera.pixel_mm / ratio, _SENSOR_LOG_SD, source))
    if camera.focal_35mm and camera.focal_35mm > 0:
        told.append(equivalent_lens(image.width_px, image.height_px, camera.focal_35mm))
    if not told:
        return None
    apart = max(abs(math.log(told[0].pixels / other.pixels)) for other in told)
    return told[0]._replace(log_sd=math.hypot(told[0].log_sd, apart / 2))


def equivalent_lens(width_px: int, height_px: int, focal_35mm: float) -> Lens:
    """The view of a focal length as on 35 mm film, by the diagonal of the sensor.

    Args:
        width_px: of the whole picture.
        height_px: of it.
        focal_35mm: millimetres.
    """
    long, short = max(width_px, height_px), min(width_px, height_px)
    wide = long / short > _WIDEST_SENSOR
    diagonal = long * _DIAGONAL_PER_WIDTH if wide else math.hypot(long, short)
    spread = math.hypot(_EQUIVALENT_LOG_SD, _WIDE_LOG_SD if wide else 0.0)
    return Lens(focal_35mm * diagonal / _FILM_DIAGONAL_MM, spread, f"{focal_35mm:g} mm (35 mm equivalent)")


def _centred(image: ImageFacts, camera: CameraMetadata) -> bool:
    """Whether a calibration speaks of the size that the picture is said to have had: its centre lies in the middle."""
    if camera.centre_x_px is None:
        return camera.taken_width_px is not None
    widths = (camera.taken_width_px,) if camera.taken_width_px else (image.width_px, image.height_px)
    return any(abs(2 * camera.centre_x_px / width - 1) <= _CENTRE_TOLERANCE for width in widths)


def _tilted(off_nadir_deg: float, unusable: str = "") -> Notice:
    looked = f"The camera looked {off_nadir_deg:.0f} degrees away from straight down"
    if unusable:
        rest = f", {unusable} its metadata are not used as a ruler: one scale does not hold for the whole picture."
    else:
        rest = ": scales differ over the picture. The one given is that of its centre; areas and distances are "
        rest += "measured on the ground as a plane."
    return Notice(code=NoticeCode.CAMERA_TILTED, message=looked + rest)


def cropped(image: ImageFacts, camera: CameraMetadata, means: str) -> Notice:
    """Tell that an image is a piece of the picture that was taken, and what that means."""
    return Notice(
        code=NoticeCode.CAMERA_CROPPED,
        message=f"The picture was taken with {camera.taken_width_px} x {camera.taken_height_px} px and has "
        f"{image.width_px} x {image.height_px}: it is a crop, and {means}. Give the original.",
    )
