"""Camera metadata as a ruler: height above take-off, focal length and sensor.

At the centre of a nadir image, the scale is ``height * pixel pitch / focal length``. The height is
that above take-off. Nearly always the ground is level with it within some metres. In the other
case, the take-off was on a hill or in a valley, and the height above the ground can be half or
double. A prior that fits the height fits other heights nearly as well, so that it hardly confirms
it; one that prefers another height supports the second case.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.imagery.metadata.camera import CameraMetadata
from vehanchor.imagery.metadata.lens import lens, perspective_problem, taken_ratio, zoom_problem
from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.camera_tilt import NADIR_TOLERANCE_DEG, TILT_SD_DEG
from vehanchor.rulers.ruler import Ruler, mark_of_height, point_witness, unusable
from vehanchor.scale.density import on_grid
from vehanchor.scale.posterior import Lack
from vehanchor.scale.reliability import (
    FILE,
    HILL_CHANCE,
    HILL_LOG_SD,
    LEVEL_SD_M,
    RELIABILITY,
    ROOF_CHANCE,
    ROOF_SD_M,
    Shared,
)

if TYPE_CHECKING:
    from vehanchor.imagery.facts import ImageFacts
    from vehanchor.imagery.metadata.lens import Lens
    from vehanchor.rulers.ruler import View
    from vehanchor.scale.posterior import Witness


# Error of the file's height that no guess repeats: two steps of the grid of scales.
_OWN_LOG_SD = 0.01
_MAX_HEIGHT_M = 20_000.0
_MAX_TILT_DEG = 85.0

# Consequences of a tilt.
_SCALE_OF_THE_CENTRE = (
    "the scale varies over the image. The given scale is that of the centre; areas and distances "
    "are measured on the ground plane."
)
_NO_LENS_IN_A_TILTED_VIEW = "without a focal length, its metadata are not usable."
_TOO_CLOSE_TO_THE_HORIZON = (
    "the image's centre is too close to the horizon for its metadata to give a scale."
)


class Camera(Ruler):
    """Height and lens in the metadata."""

    kind = "camera"
    label = "camera metadata"
    plural = True
    help = "height above take-off, or by a laser, and focal length in the file"
    colour = "#E69F00"
    pooling_gain = 0.0  # one camera and one take-off: one error
    reads_metadata = True
    uses_plane = True

    def measure(self, view: View) -> Witness | None:
        """Measure by the camera's height and lens; without either, report what is missing."""
        options = view.options.rulers
        camera = view.image.camera or CameraMetadata()
        # A focal length beside a given height belongs to that height.
        focal_35mm = options.focal_35mm if options.height_m is None else None
        tilt_deg = camera.off_nadir_deg if view.plane is None else view.plane.tilt_deg
        height = _height(camera, tilt_deg)
        problem = perspective_problem(view.image, camera)
        if problem and (height is not None or camera.projection):
            return self._unusable(problem)
        if height is None:
            return self._without_height(view, camera, focal_35mm)
        if not 0 < height.metres <= _MAX_HEIGHT_M:
            return self._unusable(f"{height.tag} is {height.metres:g} m")
        zoom = zoom_problem(camera)
        if zoom:
            return self._unusable(zoom)
        if taken_ratio(view.image, camera) is None:
            notice = cropped(view.image, camera, "the camera metadata are not usable")
            return unusable(self.kind, notice)

        optics = lens(view.image, camera, focal_35mm)
        if optics is None:
            return self._without_lens(view, camera, height.metres, tilt_deg)
        witness = self._measured(camera, height, optics, tilt_deg)
        if not witness.found:
            return witness
        return replace(witness, marks=(mark_of_height(view.image, height.metres),))

    def _without_height(
        self, view: View, camera: CameraMetadata, focal_35mm: float | None
    ) -> Witness | None:
        """Report that the height is missing.

        Without a lens, or with a height from the caller, only refused metadata are reported.
        """
        height_is_missing = view.options.rulers.height_m is None
        if height_is_missing and lens(view.image, camera, focal_35mm) is not None:
            return self._unusable(
                "the focal length is known, but the height above the ground is missing: give "
                "height_m",
                camera.refused,
            )
        if camera.refused:
            return self._unusable(camera.refused)
        return None

    def _without_lens(
        self, view: View, camera: CameraMetadata, height_m: float, tilt_deg: float | None
    ) -> Witness | None:
        """Report that the focal length is missing; not if the caller measures by a height."""
        if tilt_deg is not None and tilt_deg > NADIR_TOLERANCE_DEG:
            return unusable(self.kind, _tilted(tilt_deg, _NO_LENS_IN_A_TILTED_VIEW))
        if view.options.rulers.height_m is not None and not camera.refused:
            return None
        cause = f"the height is {height_m:g} m, but the focal length is missing: give focal_35mm"
        if camera.focal_px and camera.centre_x_px:
            cause = (
                f"the optical centre at x = {camera.centre_x_px:.0f} px is not in the middle: the "
                "image is a crop, or a copy of another size. Give the original file"
            )
        return self._unusable(cause, camera.refused)

    def _measured(
        self, camera: CameraMetadata, height: _Height, optics: Lens, tilt_deg: float | None
    ) -> Witness:
        """Measure by a height and a lens.

        Args:
            camera: the metadata.
            height: height of the camera.
            optics: the lens.
            tilt_deg: angle between the camera's axis and straight down; None if unknown.
        """
        if tilt_deg is not None and tilt_deg >= _MAX_TILT_DEG:
            return unusable(self.kind, _tilted(tilt_deg, _TOO_CLOSE_TO_THE_HORIZON))
        statement = (
            f"The camera metadata give {{}}: {height.metres:.4g} m ({height.tag}) and "
            f"{optics.source}."
        )
        condition = "camera"
        coarser = 1.0
        tilt_log_sd = 0.0
        notices = []
        if camera.refused:
            message = f"A part of the camera metadata is not used: {camera.refused}."
            notice = Notice(code=NoticeCode.CAMERA_UNUSABLE, message=message)
            notices.append(notice)
        if tilt_deg is None:
            condition = "camera, tilt unknown"
            tilt_log_sd = RELIABILITY[condition].log_sd
            statement += " The tilt is unknown: this holds at nadir."
        elif tilt_deg > NADIR_TOLERANCE_DEG:
            coarser, tilt_log_sd = coarsening(tilt_deg)
            notices.append(_tilted(tilt_deg, _SCALE_OF_THE_CENTRE))
            statement += " This is the scale of the image's centre."

        gsd = height.metres / optics.pixels * coarser
        if not on_grid(gsd):
            return self._unusable(
                f"{height.metres:.4g} m and {optics.source} would give {gsd:.3g} m/px"
            )
        # What the file states wrongly, a caller who reads the file repeats: nearly all of the error
        # is shared with guesses.
        of_file = Shared(
            FILE.name,
            math.hypot(tilt_log_sd, height.log_sd),
            chance_wrong=RELIABILITY[condition].chance_wrong,
            chance_large=height.chance_large,
            large_log_sd=math.hypot(tilt_log_sd, height.large_log_sd),
        )
        witness = point_witness(
            self.kind,
            gsd,
            log_sd=_OWN_LOG_SD,
            chance_wrong=0.0,
            statement=statement,
            shared=[lens_error(optics), of_file],
            notices=notices,
        )
        level = of_file._replace(chance_large=0.0)
        over_level_ground = replace(witness, shared=(lens_error(optics), level))
        return replace(witness, lacks=(Lack("imprecise", over_level_ground),))

    def _unusable(self, *causes: str) -> Witness:
        """Report why the metadata cannot be used; empty causes are left out."""
        stated = "; ".join(cause for cause in causes if cause)
        message = f"The camera metadata are not usable: {stated}."
        notice = Notice(code=NoticeCode.CAMERA_UNUSABLE, message=message)
        return unusable(self.kind, notice)


class _Height(NamedTuple):
    """Height of the camera in the metadata.

    Attributes:
        metres: the height.
        tag: maker and property.
        by_laser: whether a laser measured it; if not, it is one above the take-off.
    """

    metres: float
    tag: str
    by_laser: bool

    @property
    def log_sd(self) -> float:
        """Standard deviation of its log, as a height above level ground."""
        if self.by_laser:
            return math.hypot(RELIABILITY["laser"].log_sd, LEVEL_SD_M / self.metres)
        return _level_log_sd(self.metres)

    @property
    def chance_large(self) -> float:
        """Chance, 0..1, that it is not above level ground: of a roof, or of a hill."""
        return ROOF_CHANCE if self.by_laser else HILL_CHANCE

    @property
    def large_log_sd(self) -> float:
        """Standard deviation of its log in that case."""
        return ROOF_SD_M / self.metres if self.by_laser else HILL_LOG_SD


def _height(camera: CameraMetadata, tilt_deg: float | None) -> _Height | None:
    """Choose the height by a laser, which needs no level ground, or else that above take-off.

    Args:
        camera: the metadata.
        tilt_deg: angle between the camera's axis and straight down; None if unknown.
    """
    if camera.laser_m is not None and (tilt_deg is None or tilt_deg < _MAX_TILT_DEG):
        metres = camera.laser_m * math.cos(math.radians(tilt_deg or 0.0))
        return _Height(metres, camera.laser_tag, by_laser=True)
    if camera.height_m is None:
        return None
    return _Height(camera.height_m, camera.height_tag, by_laser=False)


def lens_error(optics: Lens) -> Shared:
    """Return the error that all heights over one lens have in common."""
    return Shared("lens", optics.log_sd, optics.chance_wrong)


def coarsening(tilt_deg: float) -> tuple[float, float]:
    """Compute how much coarser the scale at the centre of a tilted view is than at nadir.

    The ratio is ``cos(tilt)^-1.5`` (see ``vehanchor.scale.plane``).

    Args:
        tilt_deg: angle between the camera's axis and straight down, below 90.

    Returns:
        The ratio, and the standard deviation of its log: the slope of the log ratio times the error
        of the tilt.
    """
    tilt = math.radians(tilt_deg)
    ratio = math.cos(tilt) ** -1.5
    log_sd = 1.5 * math.tan(tilt) * math.radians(TILT_SD_DEG)
    return ratio, log_sd


def height_log_sd(height_m: float) -> float:
    """Compute the log standard deviation of a height above take-off as one above the ground.

    It is that of both cases together, level ground and a hill.
    """
    level_variance = _level_log_sd(height_m) ** 2
    hill_variance = HILL_LOG_SD**2
    return math.sqrt((1.0 - HILL_CHANCE) * level_variance + HILL_CHANCE * hill_variance)


def _level_log_sd(height_m: float) -> float:
    """Compute the log standard deviation of a height above take-off over level ground."""
    return math.hypot(RELIABILITY[Camera.kind].log_sd, LEVEL_SD_M / height_m)


def _tilted(tilt_deg: float, consequence: str) -> Notice:
    """Warn of a tilted camera, and of the consequence."""
    return Notice(
        code=NoticeCode.CAMERA_TILTED,
        message=f"The camera was tilted by {tilt_deg:.0f} degrees: {consequence}",
    )


def cropped(image: ImageFacts, camera: CameraMetadata, consequence: str) -> Notice:
    """Warn that the image is a crop of the photograph, and of the consequence."""
    cause = camera.crop
    if not cause:
        cause = (
            f"the photograph had {camera.taken_width_px} x {camera.taken_height_px} px, the image "
            f"has {image.width_px} x {image.height_px}"
        )
    message = f"The image is a crop: {cause}. Therefore {consequence}. Give the original."
    return Notice(code=NoticeCode.CAMERA_UNUSABLE, message=message)
