"""Known lengths as a ruler: lines on the ground with a length from the caller."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

from vehanchor.errors import KnownLengthError
from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.agreement import agrees
from vehanchor.rulers.evidence import Mark
from vehanchor.rulers.lognormal import combined, lognormal_evidence, mixture, no_evidence, on_grid
from vehanchor.rulers.ruler import Ruler
from vehanchor.rulers.standards import Variant, lengths_of
from vehanchor.scale.lengths import Z95
from vehanchor.tilt.camera_tilt import TILT_SD_DEG

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.options import Basis, KnownLength
    from vehanchor.rulers.evidence import View
    from vehanchor.rulers.lognormal import LognormalEvidence
    from vehanchor.scale.plane import GroundPlane

_END_SD_PX = 1.0  # error of a drawn end, in pixels of the picture where it was drawn
_SPREADS: dict[Basis, tuple[float, float]] = {
    "measured": (0.01, 0.05),  # relief, slope, and rounding of the length
    "assumed": (0.10, 0.15),
}
"""Standard deviation of the log of the length, and chance of an outlier; those of assumed facts are our assumption."""


class KnownLengths(Ruler):
    """Lines of known length on the ground."""

    kind = "known_length"
    label = "known length"
    help = "lines that you draw, and their metres or what they measure"
    colour = "#009E73"
    uses_plane = True
    independent_of_vehicles = True

    def measure(self, view: View) -> LognormalEvidence:
        """Multiply the densities of the measured lines; without any, those of the assumed ones.

        Raises:
            KnownLengthError: a line gives an impossible scale.
        """
        lines = view.options.rulers.known_lengths
        if not lines:
            return no_evidence(self.kind)
        drawn = [_drawn(line, view) for line in lines]
        each = [_evidence(group, view.options.reference.region) for group in _groups(drawn)]
        measured = [one for one in each if one.facts[0].basis == "measured"]
        found = combined(measured or each)
        basis = "measured" if measured else "assumed"
        given = f"The {len(lines)} given lines, {basis}, give" if len(lines) > 1 else f"The given line, {basis}, gives"
        return replace(
            found,
            n=len(lines),
            facts=tuple(fact for one in each for fact in one.facts),
            notices=_lines_disagree(each),
            explanation=f"{given} {found.explanation}."
            + (" This is the scale of the image's centre." if view.plane else ""),
            marks=tuple(Mark(one.ends, _label(one.line)) for one in drawn),
        )


class _Drawn(NamedTuple):
    """Line in pixels of the image.

    Attributes:
        line: the line as given.
        ends: x, y of its ends.
        length_px: its length, in pixels of the image's centre.
        log_sd: standard deviation of the log of that length.
    """

    line: KnownLength
    ends: tuple[tuple[float, float], tuple[float, float]]
    length_px: float
    log_sd: float


def _groups(drawn: Sequence[_Drawn]) -> list[list[_Drawn]]:
    """Group the lines at things of one kind; every line in metres is a group of its own."""
    groups: dict[object, list[_Drawn]] = {}
    for number, each in enumerate(drawn):
        groups.setdefault(each.line.what or number, []).append(each)
    return list(groups.values())


def _label(line: KnownLength) -> str:
    return f"{line.metres:g} m" if line.what is None else line.what.replace("_", " ")


def _drawn(line: KnownLength, view: View) -> _Drawn:
    frame = view.options.frame.size or (view.image.width_px, view.image.height_px)
    across, down = view.image.width_px / frame[0], view.image.height_px / frame[1]
    ends = (line.x1 * across, line.y1 * down), (line.x2 * across, line.y2 * down)
    length_px, tilt_log_sd = _length_at_centre(*ends, view.plane)
    return _Drawn(line, ends, length_px, math.hypot(math.sqrt(2) * _END_SD_PX / line.length_px, tilt_log_sd))


def _evidence(drawn: Sequence[_Drawn], region: str | None) -> LognormalEvidence:
    """Make the evidence of one line in metres, or of all lines at things of one kind, which share their size."""
    line = drawn[0].line
    variants: tuple[Variant, ...]
    if line.what is None:
        assert line.metres is not None
        log_sd, chance_wrong = _SPREADS[line.basis]
        if line.tolerance_m is not None:
            log_sd = line.tolerance_m / line.metres / Z95
        variants, name, family = (Variant(line.metres, log_sd),), f"known length of {line.metres:g} m", ""
    else:
        standard, variants = lengths_of(line.what, region)
        chance_wrong, name, family = standard.chance_wrong, standard.label, standard.family
    length_px, drawn_log_sd = _mean_length(drawn)
    possible = [each for each in variants if on_grid(each.metres / length_px)]
    if not possible:
        raise _impossible(variants[0].metres, length_px)
    found = [
        lognormal_evidence(
            KnownLengths.kind, each.metres / length_px, math.hypot(each.log_sd, drawn_log_sd), chance_wrong, "{}"
        )
        for each in possible
    ]
    return mixture(found, [each.weight for each in possible]).stated(name, line.basis, family)


def _mean_length(drawn: Sequence[_Drawn]) -> tuple[float, float]:
    """Average lines of one length, pixels; the spread of its log grows if the lines contradict each other."""
    weights = [1 / each.log_sd**2 for each in drawn]
    logs = [math.log(each.length_px) for each in drawn]
    mean = sum(weight * log for weight, log in zip(weights, logs, strict=True)) / sum(weights)
    off_sds = [abs(log - mean) / each.log_sd for log, each in zip(logs, drawn, strict=True)]
    return math.exp(mean), max(1.0, *off_sds) / math.sqrt(sum(weights))


def _impossible(metres: float, length_px: float) -> KnownLengthError:
    gsd = metres / length_px
    hint = f" If the length is in centimetres, give {metres / 100:g}." if on_grid(gsd / 100) else ""
    return KnownLengthError(
        f"a line of {metres:g} m over {length_px:.0f} px would give {gsd:.3g} m/px: give metres, and pixels of the "
        f"image or of the frame that you name.{hint}"
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


def _lines_disagree(lines: Sequence[LognormalEvidence]) -> tuple[Notice, ...]:
    """Warn of two lines of which neither agrees with the other's scale."""
    scales = [(each, each.gsd_m_per_px) for each in lines if each.gsd_m_per_px is not None]
    if not any(
        not agrees(one, its) and not agrees(other, this) for (one, this), (other, its) in combinations(scales, 2)
    ):
        return ()
    finest, coarsest = min(scale for _, scale in scales), max(scale for _, scale in scales)
    message = (
        f"The given lines disagree, from {finest:.4g} to {coarsest:.4g} m/px: a line is wrong, or the camera was "
        "tilted."
    )
    return (Notice(code=NoticeCode.KNOWN_LENGTHS_DISAGREE, message=message),)
