"""Known lengths as a ruler: lines on the ground with a length from the caller."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.errors import KnownLengthError
from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.camera_tilt import TILT_SD_DEG
from vehanchor.rulers.ruler import Ruler, as_assumed, in_words
from vehanchor.rulers.standards import Variant, lengths_of
from vehanchor.scale.density import lognormal, mass_within, on_grid, product, quantile
from vehanchor.scale.lengths import Z95
from vehanchor.scale.posterior import Mark, Witness
from vehanchor.scale.reliability import CALLER, RECOGNITION, RELIABILITY

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.options import KnownLength
    from vehanchor.rulers.ruler import View
    from vehanchor.scale.plane import GroundPlane

_END_SD_PX = 1.0  # error of a drawn end, in pixels of the picture where it was drawn
# that one thing of known size is mistaken, beside the caller's chance to mistake all
_LEAST_CHANCE = 0.01
# mass of one line's density within 20 % of another line's scale, below which they disagree
_AGREED = 0.05


class KnownLengths(Ruler):
    """Lines of known length on the ground."""

    kind = "known_length"
    label = "known length"
    help = "lines that you draw, and their metres or what they measure"
    colour = "#009E73"
    fact = "known_lengths"
    uses_plane = True

    def measure(self, view: View) -> Witness:
        """Multiply the densities of the measured lines; without any, those of the assumed ones.

        Raises:
            KnownLengthError: a line gives an impossible scale.
        """
        lines = view.options.rulers.known_lengths
        drawn = [_drawn(line, view) for line in lines]
        groups = _groups(drawn)
        each = [_witness(group, view.options.reference.region) for group in groups]
        measured = [
            one
            for one, group in zip(each, groups, strict=True)
            if group[0].line.basis == "measured"
        ]
        basis = "measured" if measured else "assumed"
        heard = measured or each
        # each may be wrong by itself; contradictions show as several modes
        found = (
            heard[0]
            if len(heard) == 1
            else _of_density(product(*(one.density for one in heard)), 0.0)
        )
        given = (
            f"The {len(lines)} given lines, {basis}, give"
            if len(lines) > 1
            else f"The given line, {basis}, gives"
        )
        assert found.gsd_m_per_px is not None
        assert found.interval is not None
        found = replace(
            found,
            n=len(lines),
            notices=_lines_disagree(groups, each),
            statement=f"{given} {in_words(found.gsd_m_per_px, found.interval)}."
            + (" This is the scale of the image's centre." if view.plane else ""),
            marks=tuple(Mark(one.ends, _label(one.line)) for one in drawn),
        )
        if measured:
            return found
        named = all(group[0].line.what is not None for group in groups)
        return as_assumed(found, RECOGNITION if named else CALLER)


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
    """Group the lines at things of one kind, and lines that are given twice; other lines are groups of their own."""
    groups: dict[object, list[_Drawn]] = {}
    for each in drawn:
        groups.setdefault(each.line.what or each.line, []).append(each)
    return [group if group[0].line.what else group[:1] for group in groups.values()]


def _label(line: KnownLength) -> str:
    return f"{line.length_m:g} m" if line.what is None else line.what.replace("_", " ")


def _drawn(line: KnownLength, view: View) -> _Drawn:
    frame = view.options.frame.size or (view.image.width_px, view.image.height_px)
    across = view.image.width_px / frame[0]
    down = view.image.height_px / frame[1]
    ends = (line.x1 * across, line.y1 * down), (line.x2 * across, line.y2 * down)
    length_px, tilt_log_sd = _length_at_centre(*ends, view.plane)
    return _Drawn(
        line,
        ends,
        length_px=length_px,
        log_sd=math.hypot(math.sqrt(2) * _END_SD_PX / line.length_px, tilt_log_sd),
    )


def _witness(drawn: Sequence[_Drawn], region: str | None) -> Witness:
    """Make the witness of one line in metres, or of all lines at things of one kind, which share their size."""
    line = drawn[0].line
    variants: tuple[Variant, ...]
    if line.length_m is not None:
        log_sd, chance_wrong = RELIABILITY[line.basis][:2]
        if line.tolerance_m is not None:
            log_sd = line.tolerance_m / line.length_m / Z95
        variants = (Variant(line.length_m, log_sd),)
    else:
        assert line.what is not None
        standard, variants = lengths_of(line.what, region)
        chance_wrong = max(_LEAST_CHANCE, standard.chance_wrong - RECOGNITION.chance_wrong)
    length_px, drawn_log_sd = _mean_length(drawn)
    possible = [each for each in variants if on_grid(each.metres / length_px)]
    if not possible:
        raise _impossible(variants[0].metres, length_px)
    total = sum(each.weight for each in possible)
    densities = [
        each.weight
        / total
        * lognormal(each.metres / length_px, math.hypot(each.log_sd, drawn_log_sd))
        for each in possible
    ]
    return _of_density(sum(densities, np.zeros(1)), chance_wrong)


def _of_density(right: NDArray[np.float64], chance_wrong: float) -> Witness:
    return Witness(KnownLengths.kind, quantile(right, 0.5), right=right, chance_wrong=chance_wrong)


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
        f"a line of {metres:g} m over {length_px:.0f} px would give {gsd:.3g} m/px: give "
        "metres, and pixels of the "
        f"image or of the frame that you name.{hint}"
    )


def _length_at_centre(
    first: tuple[float, float], second: tuple[float, float], plane: GroundPlane | None
) -> tuple[float, float]:
    """Compute a line's length in pixels of the image's centre, and the standard deviation of its log by the tilt."""
    if plane is None:
        return math.dist(first, second), 0.0
    less = replace(plane, gsd_m_per_px=1.0, tilt_deg=plane.tilt_deg - TILT_SD_DEG)
    here, there = (
        float(each.length([first], [second])[0])
        for each in (replace(plane, gsd_m_per_px=1.0), less)
    )
    return here, abs(math.log(here / there))


def _lines_disagree(
    groups: Sequence[Sequence[_Drawn]], lines: Sequence[Witness]
) -> tuple[Notice, ...]:
    """Warn of two lines of which neither allows the other's scale; name the line without which all agree."""
    scales = [(each.density, each.gsd_m_per_px or 0.0) for each in lines]
    apart = [
        pair
        for pair in combinations(range(len(lines)), 2)
        if max(mass_within(scales[a][0], scales[b][1]) for a, b in (pair, pair[::-1])) < _AGREED
    ]
    if not apart:
        return ()
    finest = min(scale for _, scale in scales)
    coarsest = max(scale for _, scale in scales)
    off = [k for k in range(len(lines)) if len(lines) > 2 and all(k in pair for pair in apart)]
    cause = "A line is wrong, or the camera was tilted."
    if len(off) == 1:
        cause = (
            f"Without the line {_label(groups[off[0]][0].line)} ({scales[off[0]][1]:.4g} "
            "m/px) they agree: check it."
        )
    message = f"The given lines disagree, from {finest:.4g} to {coarsest:.4g} m/px. {cause}"
    return (Notice(code=NoticeCode.KNOWN_LENGTHS_DISAGREE, message=message),)
