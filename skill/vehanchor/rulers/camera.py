"""Camera metadata as a ruler: height above take-off, focal length and sensor.

At the centre of a nadir image, the scale is ``height * pixel pitch / focal length``.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.imagery.metadata.lens import lens, taken_ratio
from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.camera_tilt import NADIR_TOLERANCE_DEG, TILT_SD_DEG
from vehanchor.rulers.ruler import Ruler, mark_of_height, point_witness, unusable
from vehanchor.scale.density import on_grid
from vehanchor.scale.reliability import RELIABILITY, Shared

if TYPE_CHECKING:
    from vehanchor.imagery.facts import ImageFacts
    from vehanchor.imagery.metadata.lens import Lens
    from vehanchor.rulers.ruler import View
    from vehanchor.scale.posterior import Witness

LENS = "lens"
"""Error that the metadata share with a given height."""

_HEIGHT_SD_M = 2.0  # barometer, and take-off from a hand or roof
_MAX_HEIGHT_M = 20_000.0
_MAX_TILT_DEG = 85.0
_MAX_DIGITAL_ZOOM = 1.01


class Camera(Ruler):
    """Height and lens in the metadata."""

    kind = "camera"
    label = "camera metadata"
    plural = True
    help = "height above take-off and focal length in the file"
    colour = "#E69F00"
    pooling_gain = 0.0  # one camera and one take-off: one error
    reads_metadata = True
    uses_plane = True

    def measure(self, view: View) -> Witness | None:
        """Measure by the camera's height and lens; without either, give no evidence and say what is missing."""
        chosen = view.options.rulers
        camera = view.image.camera or CameraMetadata()
        given_mm = chosen.focal_35mm if chosen.height_m is None else None
        if camera.height_m is None:
            return self._without_height(view, camera, given_mm)
        if not 0 < camera.height_m <= _MAX_HEIGHT_M:
            return self._unusable(f"{camera.height_tag} is {camera.height_m:g} m")
        if camera.digital_zoom > _MAX_DIGITAL_ZOOM:
            return self._unusable(
                f"the photograph was enlarged {camera.digital_zoom:g} times in the camera"
            )
        if taken_ratio(view.image, camera) is None:
            return unusable(
                self.kind, cropped(view.image, camera, "the camera metadata are not usable")
            )
        tilt_deg = camera.off_nadir_deg if view.plane is None else view.plane.tilt_deg
        seen = lens(view.image, camera, given_mm)
        if seen is None:
            if tilt_deg is not None and tilt_deg > NADIR_TOLERANCE_DEG:
                return unusable(self.kind, _tilted(tilt_deg, unusable=True))
            if chosen.height_m is not None and not camera.refused:
                return None
            known = (
                f"the height is {camera.height_m:g} m, but the focal length is missing: "
                "give focal_35mm"
            )
            return self._unusable(known, camera.refused)
        measured = self._measured(camera, camera.height_m, seen, tilt_deg)
        return (
            replace(measured, marks=(mark_of_height(view.image, camera.height_m),))
            if measured.found
            else measured
        )

    def _without_height(
        self, view: View, camera: CameraMetadata, given_mm: float | None
    ) -> Witness | None:
        """Say that the height is missing, unless the caller gives it or the focal length is missing, too."""
        if view.options.rulers.height_m is None and lens(view.image, camera, given_mm) is not None:
            return self._unusable(
                "the focal length is known, but the height above the ground is missing: give "
                "height_m",
                camera.refused,
            )
        return self._unusable(camera.refused) if camera.refused else None

    def _measured(
        self, camera: CameraMetadata, height_m: float, seen: Lens, tilt_deg: float | None
    ) -> Witness:
        tilted = tilt_deg is not None and tilt_deg > NADIR_TOLERANCE_DEG
        if tilt_deg is not None and tilt_deg >= _MAX_TILT_DEG:
            return unusable(self.kind, _tilted(tilt_deg, unusable=True))
        coarser, tilt_log_sd = coarsening(tilt_deg if tilted and tilt_deg else 0.0)
        gsd = height_m / seen.pixels * coarser
        if not on_grid(gsd):
            return self._unusable(f"{height_m:g} m and {seen.source} would make {gsd:.3g} m/px")
        said = (
            f"The camera metadata give {{}}: {height_m:g} m ({camera.height_tag}) and "
            f"{seen.source}."
        )
        condition = "camera"
        notices = []
        if camera.refused:
            message = f"A part of the camera metadata is not used: {camera.refused}."
            notices.append(Notice(code=NoticeCode.CAMERA_UNUSABLE, message=message))
        if tilted and tilt_deg is not None:
            notices.append(_tilted(tilt_deg))
            said += " This is the scale of the image's centre."
        elif tilt_deg is None:
            condition = "camera, tilt unknown"
            tilt_log_sd = RELIABILITY["camera, tilt unknown"].log_sd
            said += " The tilt is not stated: this holds at nadir."
        log_sd = math.hypot(tilt_log_sd, height_log_sd(height_m))
        chance_wrong = RELIABILITY[condition].chance_wrong
        errors = [Shared(LENS, seen.log_sd)]
        return point_witness(
            self.kind,
            gsd,
            log_sd=log_sd,
            chance_wrong=chance_wrong,
            statement=said,
            shared=errors,
            notices=notices,
        )

    def _unusable(self, *why: str) -> Witness:
        message = f"The camera metadata are not usable: {'; '.join(filter(None, why))}."
        return unusable(self.kind, Notice(code=NoticeCode.CAMERA_UNUSABLE, message=message))


def coarsening(tilt_deg: float) -> tuple[float, float]:
    """Compute the ratio of the scale at the centre of a tilted view to the scale at nadir (``vehanchor.scale.plane``).

    Args:
        tilt_deg: angle between the camera's axis and straight down, below 90.

    Returns:
        The ratio, and the standard deviation of its log.
    """
    tilt = math.radians(tilt_deg)
    return math.cos(tilt) ** -1.5, 1.5 * math.tan(tilt) * math.radians(TILT_SD_DEG)


def height_log_sd(height_m: float) -> float:
    """Compute the standard deviation of the log of a height above take-off, as one above the ground."""
    return math.hypot(RELIABILITY[Camera.kind].log_sd, _HEIGHT_SD_M / height_m)


def _tilted(tilt_deg: float, *, unusable: bool = False) -> Notice:
    rest = (
        "without height and focal length, its metadata are not usable."
        if unusable
        else "the scale varies over the image. The given scale is that of the centre; areas and "
        "distances are measured "
        "on the ground plane."
    )
    return Notice(
        code=NoticeCode.CAMERA_TILTED,
        message=f"The camera was tilted by {tilt_deg:.0f} degrees: {rest}",
    )


def cropped(image: ImageFacts, camera: CameraMetadata, means: str) -> Notice:
    """Warn that the image is a crop of the photograph, and of the consequence."""
    return Notice(
        code=NoticeCode.CAMERA_UNUSABLE,
        message=f"The image is a crop: the photograph had {camera.taken_width_px} x "
        f"{camera.taken_height_px} px, the image has {image.width_px} x {image.height_px}. "
        f"Therefore {means}. Give the "
        "original.",
    )
