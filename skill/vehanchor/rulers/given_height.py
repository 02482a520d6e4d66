"""Given height as a ruler: the camera's height above the ground, from the caller."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from vehanchor.imagery.metadata.lens import equivalent_lens, lens, taken_ratio
from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.camera import coarsening, cropped
from vehanchor.rulers.evidence import Mark
from vehanchor.rulers.lognormal import lognormal_evidence, no_evidence, on_grid
from vehanchor.rulers.ruler import Ruler
from vehanchor.scale.height import ASSUMED_HEIGHT_LOG_SD, GIVEN_HEIGHT_LOG_SD
from vehanchor.scale.lengths import Z95

if TYPE_CHECKING:
    from vehanchor.imagery.metadata.lens import Lens
    from vehanchor.options import Basis
    from vehanchor.rulers.evidence import View
    from vehanchor.rulers.lognormal import LognormalEvidence

_SPREADS: dict[Basis, tuple[float, float]] = {
    "measured": (GIVEN_HEIGHT_LOG_SD, 0.05),
    "assumed": (ASSUMED_HEIGHT_LOG_SD, 0.15),
}
"""Standard deviation of the log, and chance of an outlier; that of assumed facts is our assumption."""
_NO_LENS_OF_A_CROP = (
    "no focal length of the whole photograph holds for it, and the given height is not usable. If focal_35mm is that "
    "of the crop, leave out the metadata"
)
_FOCAL_LENGTH_MISSING = Notice(
    code=NoticeCode.FOCAL_LENGTH_MISSING,
    message="The given height is not usable: the file has no usable focal length. Also give focal_35mm.",
)


class GivenHeight(Ruler):
    """Height above the ground from the caller, with a focal length from the caller or the file."""

    kind = "height"
    label = "given height"
    help = "the height above the ground that you give, and a focal length"
    colour = "#CC79A7"
    pooling_gain = 0.0  # one height: one error
    uses_plane = True
    independent_of_vehicles = True

    def measure(self, view: View) -> LognormalEvidence:
        """Measure by the given height and the focal length."""
        chosen, image = view.options.rulers, view.image
        if chosen.height_m is None:
            return no_evidence(self.kind)
        camera = image.camera if chosen.metadata else None
        if camera is not None and taken_ratio(image, camera) is None:
            return no_evidence(self.kind, cropped(image, camera, _NO_LENS_OF_A_CROP))
        seen: Lens | None = None
        if chosen.focal_35mm is not None:
            seen = equivalent_lens(image.width_px, image.height_px, chosen.focal_35mm)
        elif camera is not None:
            seen = lens(image, camera)
        if seen is None:
            return no_evidence(self.kind, _FOCAL_LENGTH_MISSING)
        coarser, tilt_log_sd = coarsening(0.0 if view.plane is None else view.plane.tilt_deg)
        gsd = chosen.height_m / seen.pixels * coarser
        said = f"The given height, {chosen.height_basis}, gives {{}}: {chosen.height_m:g} m and {seen.source}."
        said += " This is the scale of the image's centre." if view.plane else ""
        if not on_grid(gsd):
            return no_evidence(
                self.kind,
                Notice(
                    code=NoticeCode.CAMERA_UNUSABLE,
                    message=f"The given height is not usable: {chosen.height_m:g} m and {seen.source} would give "
                    f"{gsd:.3g} m/px.",
                ),
            )
        height_log_sd, chance_wrong = _SPREADS[chosen.height_basis]
        if chosen.height_tolerance_m is not None:
            height_log_sd = chosen.height_tolerance_m / chosen.height_m / Z95
        log_sd = math.hypot(height_log_sd, seen.log_sd, tilt_log_sd)
        marks = [Mark.of_height(image, chosen.height_m)]
        found = lognormal_evidence(self.kind, gsd, log_sd, chance_wrong, said, marks=marks)
        return found.stated(f"given height of {chosen.height_m:g} m", chosen.height_basis)
