"""Known lengths as a ruler: lines on the ground with a length from the caller."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.errors import KnownLengthError
from vehanchor.options.reading import CoordinateFrame
from vehanchor.records import Notice
from vehanchor.records.notices import NoticeCode
from vehanchor.rulers.camera_tilt import TILT_SD_DEG
from vehanchor.rulers.ruler import Ruler, as_assumed, in_words
from vehanchor.rulers.standards import Variant, exact_kind, lengths_of
from vehanchor.scale.density import lognormal, mass_within, on_grid, product, quantile
from vehanchor.scale.lengths import Z95
from vehanchor.scale.posterior import Mark, Witness
from vehanchor.scale.reliability import CALLER, MEASURING, RECOGNITION, RELIABILITY, ROUGH

if TYPE_CHECKING:
    from collections.abc import Sequence
    from typing import TypeAlias

    from numpy.typing import NDArray

    from vehanchor.options import KnownLength
    from vehanchor.rulers.ruler import View
    from vehanchor.scale.density import Density
    from vehanchor.scale.plane import GroundPlane
    from vehanchor.scale.reliability import Shared

    Point: TypeAlias = tuple[float, float]
    """x, y in pixels of the image."""

    Points: TypeAlias = NDArray[np.float64]
    """``[n, 2]`` x, y in pixels of the image."""

    Direction: TypeAlias = NDArray[np.float64]
    """``[2]`` x, y of a unit vector."""

    Lines: TypeAlias = Sequence["_DrawnLine"]

# Error of a drawn end, in pixels of the picture in which it was drawn: by somebody who measures,
# and by somebody who recognises a thing. Choices.
_END_SD_PX = {"measured": 1.0, "assumed": 2.0}
# Largest difference between two lines, in standard deviations of their ends and of their scales, at
# which they are parts of one line. A choice.
_SAME_LINE_SDS = 3.0
# Smallest chance that one line at a thing of exact size is wrong, beside the chance that the caller
# mistakes all such things. A choice.
_MIN_CHANCE_WRONG = 0.01
# Two lines disagree if neither density has this mass within 20 % of the other line's scale.
_MIN_AGREED_MASS = 0.05


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
        drawn = [_draw(line, view) for line in lines]
        groups = _groups(drawn)
        region = view.options.reference.region
        witnesses = [_witness(group, region) for group in groups]
        measured = [
            witness
            for witness, group in zip(witnesses, groups, strict=True)
            if group[0].known_length.basis == "measured"
        ]
        basis = "measured" if measured else "assumed"
        combined = _combined(measured or witnesses)
        assert combined.gsd_m_per_px is not None
        assert combined.interval is not None

        subject = f"The given line, {basis}, gives"
        if len(lines) > 1:
            subject = f"The {len(lines)} given lines, {basis}, give"
        statement = f"{subject} {in_words(combined.gsd_m_per_px, combined.interval)}."
        if view.plane is not None:
            statement += " This is the scale of the image's centre."
        marks = [Mark(line.ends, _label(line.known_length)) for line in drawn]
        witness = replace(
            combined,
            n=len(lines),
            notices=_disagreement(groups, witnesses),
            statement=statement,
            marks=tuple(marks),
        )
        if measured:
            return replace(witness, shared=(*witness.shared, MEASURING))
        if _differ_in_kind(lines):
            return as_assumed(witness, RECOGNITION)
        return as_assumed(witness, CALLER)


def _differ_in_kind(lines: Sequence[KnownLength]) -> bool:
    """Test whether all lines are things of exact size, and of more than one kind.

    A caller who recognises a court and a container hardly mistakes both. Several guesses, or
    several things of one kind, can be one mistake.
    """
    kinds = set()
    for line in lines:
        kind = None
        if line.what is not None:
            kind = exact_kind(line.what)
        if kind is None:
            return False
        kinds.add(kind)
    return len(kinds) > 1


class _DrawnLine(NamedTuple):
    """Line in pixels of the image.

    Attributes:
        known_length: the line as the caller gives it.
        ends: x, y of its ends.
        length_px: its length, or that of one of several equal things in a row, in pixels of the
            image's centre.
        log_sd: standard deviation of the log of that length.
        end_sd_px: error of an end, pixels of the image.
    """

    known_length: KnownLength
    ends: tuple[Point, Point]
    length_px: float
    log_sd: float
    end_sd_px: float


def _draw(line: KnownLength, view: View) -> _DrawnLine:
    """Convert a line from the caller's copy of the image to the image."""
    image = view.image
    x_factor, y_factor = CoordinateFrame(view.options.frame, image.grid).unit_of_copy_px
    first = (line.x1 * x_factor, line.y1 * y_factor)
    second = (line.x2 * x_factor, line.y2 * y_factor)
    length_px, tilt_log_sd = _length_at_centre(first, second, view.plane)
    # Both ends have the error of drawing, in pixels of the caller's copy.
    end_sd_px = _END_SD_PX[line.basis]
    drawing_log_sd = math.sqrt(2) * end_sd_px / line.length_px
    return _DrawnLine(
        line,
        (first, second),
        length_px=length_px / line.n_things,
        log_sd=math.hypot(drawing_log_sd, tilt_log_sd),
        end_sd_px=end_sd_px * max(x_factor, y_factor),
    )


def _length_at_centre(
    first: Point, second: Point, plane: GroundPlane | None
) -> tuple[float, float]:
    """Compute the length of a line in pixels of the image's centre.

    Args:
        first: x, y of an end, pixels of the image.
        second: x, y of the other end.
        plane: ground plane of a tilted view; None at nadir.

    Returns:
        The length, and the standard deviation of its log by the error of the tilt.
    """
    if plane is None:
        return math.dist(first, second), 0.0
    # With 1 m/px at the centre, metres on the ground are pixels of the centre. The same line on a
    # plane that is less tilted by one standard deviation shows the error of the tilt.
    unit_plane = replace(plane, gsd_m_per_px=1.0)
    less_tilted = replace(unit_plane, tilt_deg=plane.tilt_deg - TILT_SD_DEG)
    [length_px] = unit_plane.length([first], [second])
    [less_tilted_px] = less_tilted.length([first], [second])
    log_ratio = math.log(float(length_px) / float(less_tilted_px))
    return float(length_px), abs(log_ratio)


def _groups(drawn: Lines) -> list[list[_DrawnLine]]:
    """Group the lines at things of one kind, and the parts and copies of one line.

    Each other line is a group of its own.
    """
    groups: list[list[_DrawnLine]] = []
    for line in drawn:
        # A line can join groups that had nothing in common before: they become one.
        joined = [line]
        others = []
        for group in groups:
            if any(_belong_together(line, other) for other in group):
                joined = [*group, *joined]
            else:
                others.append(group)
        groups = [*others, joined]
    return groups


def _belong_together(first: _DrawnLine, second: _DrawnLine) -> bool:
    """Test whether two lines have one length on the ground, or are parts of one line."""
    one = first.known_length
    other = second.known_length
    if one.what is not None or other.what is not None:
        return _bare_name(one) == _bare_name(other)
    if one.basis != other.basis:
        return False
    return _are_one_line(first, second) and _have_one_scale(first, second)


def _bare_name(line: KnownLength) -> str | None:
    """Return the name of a thing of known size without its country; None for metres."""
    return None if line.what is None else line.what.partition("/")[0]


def _are_one_line(first: _DrawnLine, second: _DrawnLine) -> bool:
    """Test whether lines are collinear, and overlap or adjoin, within the error of their ends."""
    end_sd_px = math.hypot(first.end_sd_px, second.end_sd_px)
    tolerance_px = _SAME_LINE_SDS * end_sd_px
    ends = np.array([*first.ends, *second.ends])
    along = _direction(ends)
    across = np.array([-along[1], along[0]])
    if np.ptp(ends @ across) > tolerance_px:
        return False
    positions = (ends @ along).reshape(2, 2)
    later_start = positions.min(axis=1).max()
    earlier_end = positions.max(axis=1).min()
    # The gap is negative if the lines overlap.
    gap_px = later_start - earlier_end
    return bool(gap_px <= tolerance_px)


def _without_copies(lines: Lines) -> list[_DrawnLine]:
    """Leave out lines whose ends are those of an earlier line, within the error of the ends.

    Things of one kind can adjoin, as lanes do, so that only copies are one thing.
    """
    distinct: list[_DrawnLine] = []
    for line in lines:
        if not any(_have_same_ends(line, other) for other in distinct):
            distinct.append(line)
    return distinct


def _have_same_ends(first: _DrawnLine, second: _DrawnLine) -> bool:
    """Test whether the ends of two lines coincide, in either order."""
    tolerance_px = _SAME_LINE_SDS * math.hypot(first.end_sd_px, second.end_sd_px)
    start, end = first.ends
    for other_start, other_end in (second.ends, second.ends[::-1]):
        farthest_px = max(math.dist(start, other_start), math.dist(end, other_end))
        if farthest_px <= tolerance_px:
            return True
    return False


def _direction(points: Points) -> Direction:
    """Find the direction of a line through points: their principal axis."""
    offsets = points - points.mean(axis=0)
    _, _, axes = np.linalg.svd(offsets, full_matrices=False)
    return np.asarray(axes[0])


def _have_one_scale(first: _DrawnLine, second: _DrawnLine) -> bool:
    """Test whether the scales of two lines in metres agree within their errors."""
    log_ratio = _log_gsd(first) - _log_gsd(second)
    log_ratio_sd = math.hypot(_log_gsd_sd(first), _log_gsd_sd(second))
    return abs(log_ratio) <= _SAME_LINE_SDS * log_ratio_sd


def _log_gsd(line: _DrawnLine) -> float:
    """Compute the log of the scale by a line in metres."""
    assert line.known_length.length_m is not None
    return math.log(line.known_length.length_m / line.length_px)


def _log_gsd_sd(line: _DrawnLine) -> float:
    """Compute the log standard deviation of that scale, by the drawing and by the metres."""
    return math.hypot(line.log_sd, _log_sd_of_metres(line))


def _log_sd_of_metres(line: _DrawnLine) -> float:
    """Return the log standard deviation of a line's metres, by its tolerance or its basis."""
    known = line.known_length
    if known.tolerance_m is None or known.length_m is None:
        return RELIABILITY[known.basis].log_sd
    return known.tolerance_m / known.length_m / Z95


def _label(line: KnownLength) -> str:
    """Name a line in pictures and messages."""
    if line.what is None:
        return f"{line.length_m:g} m"
    name = line.what.replace("_", " ")
    return name if line.n_things == 1 else f"{line.n_things} x {name}"


def _witness(group: Lines, region: str | None) -> Witness:
    """Make the witness of the parts of one line, or of all lines at things of one kind.

    Things of one kind in one image share their size, so that their lines are averaged. So are
    lines that are parts or copies of one line.

    Args:
        group: the lines.
        region: country or region of the image; None if unknown.

    Raises:
        KnownLengthError: the lines give an impossible scale.
    """
    line = group[0].known_length
    variants: tuple[Variant, ...]
    shared: tuple[Shared, ...] = ()
    if line.length_m is not None:
        if line.basis == "assumed" and line.tolerance_m is None:
            shared = (ROUGH,)
        chance_wrong = RELIABILITY[line.basis].chance_wrong
        # The same metres in several parts have one error, that of the most exact statement.
        log_sd = min(_log_sd_of_metres(part) for part in group)
        variants = (Variant(line.length_m, log_sd),)
        length_px, drawing_log_sd = _whole_length(group, line.length_m)
    else:
        assert line.what is not None
        standard, variants = lengths_of(line.what, region)
        # The chance that the caller mistakes all things is a shared error; see RECOGNITION.
        own_chance = standard.chance_wrong - RECOGNITION.chance_wrong
        chance_wrong = max(_MIN_CHANCE_WRONG, own_chance)
        length_px, drawing_log_sd = _mean_length(_without_copies(group))
    right = _mixture(variants, length_px, drawing_log_sd)
    return _of_density(right, chance_wrong, shared)


def _mixture(variants: Sequence[Variant], length_px: float, drawing_log_sd: float) -> Density:
    """Mix the densities of the scale by each usual length of a thing, by their weights.

    Args:
        variants: the usual lengths; those with an impossible scale do not count.
        length_px: length of the line, pixels of the image's centre.
        drawing_log_sd: standard deviation of the log of ``length_px``.

    Returns:
        ``[g]`` density.

    Raises:
        KnownLengthError: all scales are impossible.
    """
    possible = [variant for variant in variants if on_grid(variant.metres / length_px)]
    if not possible:
        raise _impossible(variants[0].metres, length_px)
    total_weight = sum(variant.weight for variant in possible)
    mixture = np.zeros(1)
    for variant in possible:
        log_sd = math.hypot(variant.log_sd, drawing_log_sd)
        density = lognormal(variant.metres / length_px, log_sd)
        share = variant.weight / total_weight
        mixture = mixture + share * density
    return mixture


def _whole_length(parts: Lines, metres: float) -> tuple[float, float]:
    """Average the scales of the parts and copies of one line, as pixels of a length on the ground.

    Args:
        parts: the lines.
        metres: the length on the ground.

    Returns:
        The mean, and the standard deviation of its log. It is that of one line over all parts: a
        line is no more exact in pieces, nor if it is given twice.
    """
    # Each part gives the pixels of the same metres at its scale, with the weight of its own error.
    lines = []
    for part in parts:
        gsd_m_per_px = math.exp(_log_gsd(part))
        lines.append(part._replace(length_px=metres / gsd_m_per_px))
    length_px, _ = _mean_length(lines)

    ends = np.array([part.ends for part in parts]).reshape(-1, 2)
    positions = ends @ _direction(ends)
    whole_px = float(np.ptp(positions))
    # The ends have the same error in pixels, which is a smaller share of the whole line. The rest
    # of a part's error is that of the tilt, which all parts have in common.
    log_sds = []
    for part in parts:
        ends_sd_px = math.sqrt(2) * part.end_sd_px
        part_variance = (ends_sd_px / math.dist(*part.ends)) ** 2
        tilt_variance = max(0.0, part.log_sd**2 - part_variance)
        log_sds.append(math.hypot(ends_sd_px / whole_px, math.sqrt(tilt_variance)))
    return length_px, min(log_sds)


def _mean_length(group: Lines) -> tuple[float, float]:
    """Average lines of one length by their precisions, pixels.

    Returns:
        The mean, and the standard deviation of its log, which grows if the lines contradict each
        other.
    """
    weights = [1 / line.log_sd**2 for line in group]
    log_lengths = [math.log(line.length_px) for line in group]
    pairs = zip(weights, log_lengths, strict=True)
    total = sum(weight * log_length for weight, log_length in pairs)
    mean = total / sum(weights)
    # The largest deviation, in standard deviations of its line, widens the error of the mean.
    widening = 1.0
    for line, log_length in zip(group, log_lengths, strict=True):
        deviation = abs(log_length - mean) / line.log_sd
        widening = max(widening, deviation)
    log_sd = widening / math.sqrt(sum(weights))
    return math.exp(mean), log_sd


def _impossible(metres: float, length_px: float) -> KnownLengthError:
    """Describe a line with an impossible scale; a length in centimetres gets a hint."""
    gsd = metres / length_px
    hint = ""
    if on_grid(gsd / 100):
        hint = f" If the length is in centimetres, give {metres / 100:g}."
    return KnownLengthError(
        f"a line of {metres:g} m over {length_px:.0f} px would give {gsd:.3g} m/px: give metres, "
        f"and pixels of the image or of the frame that you name.{hint}"
    )


def _of_density(right: Density, chance_wrong: float, shared: tuple[Shared, ...]) -> Witness:
    """Make a witness whose own scale is the median of a density ``[g]``."""
    median = quantile(right, 0.5)
    return Witness(KnownLengths.kind, median, right=right, chance_wrong=chance_wrong, shared=shared)


def _combined(witnesses: Sequence[Witness]) -> Witness:
    """Combine the witnesses of all lines.

    Each line may be wrong by itself, which its density includes. Contradictions show as several
    modes of the product. An error that all lines share does not shrink in the product.
    """
    if len(witnesses) == 1:
        return witnesses[0]
    shared: tuple[Shared, ...] = ()
    if all(witness.shared for witness in witnesses):
        shared = witnesses[0].shared
        witnesses = [replace(witness, shared=()) for witness in witnesses]
    densities = [witness.density for witness in witnesses]
    return _of_density(product(*densities), chance_wrong=0.0, shared=shared)


def _disagreement(groups: Sequence[Lines], witnesses: Sequence[Witness]) -> tuple[Notice, ...]:
    """Warn of lines that exclude each other's scale; name the line without which all agree.

    Args:
        groups: the lines.
        witnesses: witness of each group.
    """
    numbers = range(len(witnesses))
    contradictions = []
    for a, b in combinations(numbers, 2):
        if not _agree(witnesses[a], witnesses[b]):
            contradictions.append((a, b))
    if not contradictions:
        return ()
    cause = "A line is wrong, or the camera was tilted."
    # With more than two lines, one that is in all contradictions is probably the wrong one.
    suspects = []
    if len(witnesses) > 2:
        suspects = [k for k in numbers if all(k in pair for pair in contradictions)]
    if len(suspects) == 1:
        [suspect] = suspects
        label = _label(groups[suspect][0].known_length)
        gsd = witnesses[suspect].gsd_m_per_px
        cause = f"Without the line {label} ({gsd:.4g} m/px) they agree: check it."
    scales = [witness.gsd_m_per_px or 0.0 for witness in witnesses]
    message = f"The given lines disagree, from {min(scales):.4g} to {max(scales):.4g} m/px. {cause}"
    return (Notice(code=NoticeCode.KNOWN_LENGTHS_DISAGREE, message=message),)


def _agree(first: Witness, second: Witness) -> bool:
    """Test whether one of two lines allows the scale of the other."""
    assert first.gsd_m_per_px is not None
    assert second.gsd_m_per_px is not None
    mass_by_first = mass_within(first.density, second.gsd_m_per_px)
    mass_by_second = mass_within(second.density, first.gsd_m_per_px)
    return max(mass_by_first, mass_by_second) >= _MIN_AGREED_MASS
