"""The caller as a ruler: lines on the ground whose length is known, or the camera's height above the ground."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from vehanchor.errors import KnownLengthError
from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.camera import TILT_SD_DEG, cropped, equivalent_lens, lens, looking_aside, taken_ratio
from vehanchor.rulers.evidence import Mark
from vehanchor.rulers.lognormal import lognormal_evidence, no_evidence, on_grid

if TYPE_CHECKING:
    from vehanchor.rulers.camera import Lens
    from vehanchor.rulers.evidence import View
    from vehanchor.rulers.lognormal import LognormalEvidence
    from vehanchor.scale.plane import GroundPlane

_END_SD_PX = 1.0  # how well a person hits an end, in pixels of the picture in which it was drawn
_LINE_LOG_SD = 0.01  # a line lies on ground that is neither flat nor level, and its metres are rounded
_LINES_APART_SDS = 3.0
_HEIGHT_LOG_SD = 0.05  # the caller knows the height above the ground itself
_CHANCE_WRONG_LINE, _CHANCE_WRONG_HEIGHT = 0.05, 0.05


class KnownLengths:
    """Lines that the caller has measured on the ground."""

    kind = "known_length"

    def look(self, view: View, plane: GroundPlane | None = None) -> LognormalEvidence:
        """Weigh the lines by how many pixels each has.

        Args:
            view: of the image.
            plane: the ground, where the camera looked aside; its scale does not matter.

        Returns:
            The scale, of the image's centre where the camera looked aside.

        Raises:
            KnownLengthError: they would make a scale that no picture has.
        """
        lines = view.options.rulers.known_lengths
        if not lines:
            return no_evidence(self.kind)
        frame = view.options.frame.size or (view.image.width_px, view.image.height_px)
        across, down = view.image.width_px / frame[0], view.image.height_px / frame[1]
        logs, log_sds = [], []
        for line in lines:
            ends = (line.x1 * across, line.y1 * down), (line.x2 * across, line.y2 * down)
            length_px, tilt_log_sd = _as_at_the_centre(*ends, plane)
            if not on_grid(line.metres / length_px):
                raise KnownLengthError(
                    f"a line of {line.metres:g} m over {length_px:.0f} px would make {line.metres / length_px:.3g} "
                    "m/px: give metres, and pixels of the image or of the frame that you name"
                )
            logs.append(math.log(line.metres / length_px))
            log_sds.append(math.hypot(math.sqrt(2) * _END_SD_PX / line.length_px, _LINE_LOG_SD, tilt_log_sd))
        weights = [1 / sd**2 for sd in log_sds]
        mean = sum(weight * log for weight, log in zip(weights, logs, strict=True)) / sum(weights)
        off_sds = [abs(log - mean) / sd for log, sd in zip(logs, log_sds, strict=True)]
        log_sd = max(1.0, *off_sds) / math.sqrt(sum(weights))
        scales = sorted(math.exp(log) for log in logs)
        apart = max(off_sds) > _LINES_APART_SDS
        said = f"The {len(lines)} given lines say {{}}." if len(lines) > 1 else "The given line says {}."
        said += _AT_THE_CENTRE if plane else ""
        return lognormal_evidence(
            self.kind,
            math.exp(mean),
            log_sd,
            _CHANCE_WRONG_LINE,
            said,
            n=len(lines),
            notices=[_lines_disagree(scales[0], scales[-1])] if apart else (),
            marks=[
                Mark(((line.x1 * across, line.y1 * down), (line.x2 * across, line.y2 * down)), f"{line.metres:g} m")
                for line in lines
            ],
        )


class GivenHeight:
    """The height above the ground that the caller gives, with a focal length of its own or the file's."""

    kind = "height"

    def look(self, view: View, tilt_deg: float = 0.0) -> LognormalEvidence:
        """Measure by the given height.

        Args:
            view: of the image.
            tilt_deg: angle between the camera's axis and straight down, where it is known that it looked aside.

        Returns:
            The scale, of the image's centre where the camera looked aside.
        """
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
        coarser, tilt_log_sd = looking_aside(tilt_deg)
        gsd = chosen.height_m / seen.pixels * coarser
        said = f"The given height says {{}}: {chosen.height_m:g} m and {seen.source}."
        said += _AT_THE_CENTRE if tilt_deg else ""
        if not on_grid(gsd):
            return no_evidence(
                self.kind,
                Notice(
                    code=NoticeCode.CAMERA_UNUSABLE,
                    message=f"The given height is no ruler: {chosen.height_m:g} m and {seen.source} would make "
                    f"{gsd:.3g} m/px.",
                ),
            )
        log_sd, marks = math.hypot(_HEIGHT_LOG_SD, seen.log_sd, tilt_log_sd), [Mark.of_height(image, chosen.height_m)]
        return lognormal_evidence(self.kind, gsd, log_sd, _CHANCE_WRONG_HEIGHT, said, marks=marks)


_AT_THE_CENTRE = " At the image's centre."
_NO_LENS_OF_A_CROP = (
    "no focal length of the whole picture holds for it: the given height is no ruler. If focal_35mm is that of the "
    "crop, leave the metadata out"
)
_FOCAL_LENGTH_MISSING = Notice(
    code=NoticeCode.FOCAL_LENGTH_MISSING,
    message="A height was given, but no focal length, and the file has none that holds for it: give focal_35mm, too.",
)


def _as_at_the_centre(
    first: tuple[float, float], second: tuple[float, float], plane: GroundPlane | None
) -> tuple[float, float]:
    """Pixels that a line would have at the image's centre, seen from straight above, and the log's spread of that."""
    if plane is None:
        return math.dist(first, second), 0.0
    less = replace(plane, gsd_m_per_px=1.0, tilt_deg=plane.tilt_deg - TILT_SD_DEG)
    here, there = (float(each.length([first], [second])[0]) for each in (replace(plane, gsd_m_per_px=1.0), less))
    return here, abs(math.log(here / there))


def _lines_disagree(finest: float, coarsest: float) -> Notice:
    return Notice(
        code=NoticeCode.KNOWN_LENGTHS_DISAGREE,
        message=f"The given lines say from {finest:.4g} to {coarsest:.4g} m/px, further apart than pixels explain: one "
        "of them is wrong, or the camera looked aslant.",
    )
