"""Given height as a ruler: the camera's height above the ground, from the caller."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from vehanchor.imagery.metadata.lens import lens, taken_ratio
from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.active import uses
from vehanchor.rulers.camera import LENS, coarsening, cropped
from vehanchor.rulers.ruler import Ruler, as_assumed, mark_of_height, point_witness, unusable
from vehanchor.scale.density import on_grid
from vehanchor.scale.lengths import Z95
from vehanchor.scale.reliability import RELIABILITY, SAME_NUMBER, Shared

if TYPE_CHECKING:
    from vehanchor.rulers.ruler import View
    from vehanchor.scale.posterior import Witness

_NO_LENS_OF_A_CROP = (
    "no focal length of the whole photograph holds for it, and the given height is not usable. "
    "If yours is that "
    "of the crop, leave out the metadata"
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
        chosen = view.options.rulers
        image = view.image
        assert chosen.height_m is not None
        camera = image.camera if chosen.metadata else None
        if camera is not None and taken_ratio(image, camera) is None:
            return unusable(self.kind, cropped(image, camera, _NO_LENS_OF_A_CROP))
        if _repeats(view, chosen.height_m):
            return unusable(self.kind, _repeated(chosen.height_m))
        seen = lens(image, camera, chosen.focal_35mm)
        if seen is None:
            return _unusable("the file has no usable focal length. Also give its 35 mm equivalent")
        coarser, tilt_log_sd = coarsening(0.0 if view.plane is None else view.plane.tilt_deg)
        gsd = chosen.height_m / seen.pixels * coarser
        said = (
            f"The given height, {chosen.height_basis}, gives {{}}: {chosen.height_m:g} m and "
            f"{seen.source}."
        )
        said += " This is the scale of the image's centre." if view.plane else ""
        if not on_grid(gsd):
            return _unusable(f"{chosen.height_m:g} m and {seen.source} would give {gsd:.3g} m/px")
        reliability = RELIABILITY[
            "assumed" if chosen.height_basis == "assumed" else "measured height"
        ]
        log_sd = reliability.log_sd
        if chosen.height_tolerance_m is not None:
            log_sd = chosen.height_tolerance_m / chosen.height_m / Z95
        found = point_witness(
            self.kind,
            gsd,
            log_sd=math.hypot(log_sd, tilt_log_sd),
            chance_wrong=reliability.chance_wrong,
            statement=said,
            shared=[Shared(LENS, seen.log_sd)],
            marks=[mark_of_height(image, chosen.height_m)],
        )
        return as_assumed(found) if chosen.height_basis == "assumed" else found


def _unusable(why: str) -> Witness:
    message = f"The given height is not usable: {why}."
    return unusable(GivenHeight.kind, Notice(code=NoticeCode.CAMERA_UNUSABLE, message=message))


def _repeats(view: View, height_m: float) -> bool:
    """Test whether a given height is the file's, which the ruler camera uses: the same number is one witness."""
    camera = view.image.camera
    if camera is None or camera.height_m is None or not uses(view.options.rulers, "camera"):
        return False
    return (
        lens(view.image, camera) is not None
        and abs(height_m - camera.height_m) <= SAME_NUMBER * camera.height_m
    )


def _repeated(height_m: float) -> Notice:
    return Notice(
        code=NoticeCode.HEIGHT_REPEATED,
        message=f"The given height of {height_m:g} m is the file's own: it counts once, as the "
        "file's. If it was "
        "measured on its own, leave out the metadata.",
    )
