"""Given height as a ruler: the camera's height above the ground, from the caller."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from vehanchor.imagery.metadata.lens import lens, perspective_problem, taken_ratio, zoom_problem
from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.active import uses
from vehanchor.rulers.camera import coarsening, cropped, lens_error
from vehanchor.rulers.ruler import Ruler, as_assumed, mark_of_height, point_witness, unusable
from vehanchor.scale.density import on_grid
from vehanchor.scale.lengths import Z95
from vehanchor.scale.reliability import MEASURING, RELIABILITY, ROUGH, SAME_NUMBER

if TYPE_CHECKING:
    from vehanchor.rulers.ruler import View
    from vehanchor.scale.posterior import Witness

_NO_LENS_OF_A_CROP = (
    "no focal length of the whole photograph holds for it, and the given height is not usable. "
    "If yours is that of the crop, leave out the metadata"
)


class GivenHeight(Ruler):
    """Height above the ground from the caller, with a focal length from the caller or the file."""

    kind = "height"
    label = "given height"
    help = "the height above the ground that you give, and a focal length"
    colour = "#CC79A7"
    pooling_gain = 0.0  # one height: one error
    fact = "height_m"
    uses_plane = True

    def measure(self, view: View) -> Witness:
        """Measure by the given height and the focal length."""
        options = view.options.rulers
        image = view.image
        height_m = options.height_m
        assert height_m is not None
        camera = image.camera if options.metadata else None
        if camera is not None and taken_ratio(image, camera) is None:
            return unusable(self.kind, cropped(image, camera, _NO_LENS_OF_A_CROP))
        problem = perspective_problem(image, camera)
        if problem:
            return _unusable(problem)
        if _repeats_metadata(view, height_m):
            return unusable(self.kind, _repeated(height_m))
        optics = lens(image, camera, options.focal_35mm)
        if optics is None:
            cause = zoom_problem(camera) or "the file has no usable focal length"
            return _unusable(f"{cause}. Also give its 35 mm equivalent")

        tilt_deg = 0.0 if view.plane is None else view.plane.tilt_deg
        coarser, tilt_log_sd = coarsening(tilt_deg)
        gsd = height_m / optics.pixels * coarser
        if not on_grid(gsd):
            return _unusable(f"{height_m:g} m and {optics.source} would give {gsd:.3g} m/px")
        is_assumed = options.height_basis == "assumed"
        reliability = RELIABILITY["assumed" if is_assumed else "measured height"]
        height_sd = reliability.log_sd
        shared = [lens_error(optics)]
        if options.height_tolerance_m is not None:
            height_sd = options.height_tolerance_m / height_m / Z95
        elif is_assumed:
            shared.append(ROUGH)
        statement = (
            f"The given height, {options.height_basis}, gives {{}}: {height_m:g} m and "
            f"{optics.source}."
        )
        if view.plane is not None:
            statement += " This is the scale of the image's centre."
        if not is_assumed:
            shared.append(MEASURING)
        witness = point_witness(
            self.kind,
            gsd,
            log_sd=math.hypot(height_sd, tilt_log_sd),
            chance_wrong=reliability.chance_wrong,
            statement=statement,
            shared=shared,
            marks=[mark_of_height(image, height_m)],
        )
        return as_assumed(witness) if is_assumed else witness


def _unusable(cause: str) -> Witness:
    """Report why the given height cannot be used."""
    message = f"The given height is not usable: {cause}."
    notice = Notice(code=NoticeCode.CAMERA_UNUSABLE, message=message)
    return unusable(GivenHeight.kind, notice)


def _repeats_metadata(view: View, height_m: float) -> bool:
    """Test whether a given height is the file's, which the ruler ``camera`` uses.

    The same number is one witness: a copy would confirm it without new evidence.
    """
    camera = view.image.camera
    if camera is None:
        return False
    if not uses(view.options.rulers, "camera"):
        return False
    if lens(view.image, camera) is None:
        return False
    stated = (camera.height_m, camera.laser_m)
    return any(_is_same(height_m, stated_m) for stated_m in stated if stated_m is not None)


def _is_same(height_m: float, stated_m: float) -> bool:
    """Test whether a height is the number that the file states."""
    return abs(height_m - stated_m) <= SAME_NUMBER * stated_m


def _repeated(height_m: float) -> Notice:
    """Warn that a given height repeats the file's."""
    return Notice(
        code=NoticeCode.HEIGHT_REPEATED,
        message=(
            f"The given height of {height_m:g} m repeats that of the file, so that it counts once. "
            "If it was measured independently, leave out the metadata, and give the 35 mm "
            "equivalent of the focal length."
        ),
    )
