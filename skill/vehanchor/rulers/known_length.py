"""Known lengths as a ruler: lines on the ground with a length from the caller."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from vehanchor.errors import KnownLengthError
from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.evidence import Mark
from vehanchor.rulers.lognormal import lognormal_evidence, no_evidence, on_grid
from vehanchor.rulers.ruler import Ruler
from vehanchor.tilt.camera_tilt import TILT_SD_DEG

if TYPE_CHECKING:
    from vehanchor.rulers.evidence import View
    from vehanchor.rulers.lognormal import LognormalEvidence
    from vehanchor.scale.plane import GroundPlane

_END_SD_PX = 1.0  # error of a drawn end, in pixels of the picture where it was drawn
_LINE_LOG_SD = 0.01  # relief, slope, and rounding of the length
_LINES_APART_SDS = 3.0
_CHANCE_WRONG = 0.05


class KnownLengths(Ruler):
    """Lines of known length on the ground."""

    kind = "known_length"
    label = "known length"
    help = "lines that you draw, and their metres"
    colour = "#009E73"
    uses_plane = True
    independent_of_vehicles = True

    def measure(self, view: View) -> LognormalEvidence:
        """Average the lines, weighted by their lengths in pixels.

        Raises:
            KnownLengthError: a line gives an impossible scale.
        """
        lines = view.options.rulers.known_lengths
        if not lines:
            return no_evidence(self.kind)
        frame = view.options.frame.size or (view.image.width_px, view.image.height_px)
        across, down = view.image.width_px / frame[0], view.image.height_px / frame[1]
        logs, log_sds = [], []
        for line in lines:
            ends = (line.x1 * across, line.y1 * down), (line.x2 * across, line.y2 * down)
            length_px, tilt_log_sd = _length_at_centre(*ends, view.plane)
            if not on_grid(line.metres / length_px):
                raise KnownLengthError(
                    f"a line of {line.metres:g} m over {length_px:.0f} px would give {line.metres / length_px:.3g} "
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
        said = f"The {len(lines)} given lines give {{}}." if len(lines) > 1 else "The given line gives {}."
        said += " This is the scale of the image's centre." if view.plane else ""
        return lognormal_evidence(
            self.kind,
            math.exp(mean),
            log_sd,
            _CHANCE_WRONG,
            said,
            n=len(lines),
            notices=[_lines_disagree(scales[0], scales[-1])] if apart else (),
            marks=[
                Mark(((line.x1 * across, line.y1 * down), (line.x2 * across, line.y2 * down)), f"{line.metres:g} m")
                for line in lines
            ],
        )


def _length_at_centre(
    first: tuple[float, float], second: tuple[float, float], plane: GroundPlane | None
) -> tuple[float, float]:
    """Compute a line's length in pixels of the image's centre, and the standard deviation of its log by the tilt."""
    if plane is None:
        return math.dist(first, second), 0.0
    less = replace(plane, gsd_m_per_px=1.0, tilt_deg=plane.tilt_deg - TILT_SD_DEG)
    here, there = (float(each.length([first], [second])[0]) for each in (replace(plane, gsd_m_per_px=1.0), less))
    return here, abs(math.log(here / there))


def _lines_disagree(finest: float, coarsest: float) -> Notice:
    return Notice(
        code=NoticeCode.KNOWN_LENGTHS_DISAGREE,
        message=f"The given lines disagree, from {finest:.4g} to {coarsest:.4g} m/px: a line is wrong, or the camera "
        "was tilted.",
    )
