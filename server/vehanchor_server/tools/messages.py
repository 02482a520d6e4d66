"""Answers in words: the rule for planners, and what each record says."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from vehanchor.records import AreaMeasurement, DistanceMeasurement, GsdEstimate
from vehanchor.records.text import advice_for, by_hand_text, ruler_names, significant
from vehanchor_server.calls.compact import brief, has_unknown_extent
from vehanchor_server.calls.remedies import advice_on

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.records import Notice, OtherObject
    from vehanchor_server.calls.reply import Detail

POLICY = (
    "Act on the scale only if status is ok: it is right within 20 % in at least 9 of 10 such "
    "photographs. "
    "Otherwise use another ruler. no_scale: no ruler was found, gsd_m_per_px is null, never a "
    "guess."
)
"""The rule for planners in the description of ``estimate_gsd``."""

STATUS_RULES = (
    "status ok: use it, but compare the interval's low end with what you need. low_confidence: "
    "do not act on it. "
    "no_scale: only pixels. Scale arguments: see estimate_gsd."
)
"""The meaning of ``status`` in the descriptions of the measuring tools."""

AnyRecord: TypeAlias = GsdEstimate | AreaMeasurement | DistanceMeasurement
# of a short answer; a token of a model has about four characters
_ESTIMATE_CHARS = 320
_MEASUREMENT_CHARS = 520
_PREFIX = "Warning "


class Answer(NamedTuple):
    """Answer in words.

    Attributes:
        text: all of it.
        warnings: those of the records and the hints, for the structured content.
    """

    text: str
    warnings: tuple[str, ...]


def answer_of(records: Sequence[AnyRecord], hints: Sequence[str], detail: Detail) -> Answer:
    """Say the records of an image in words, numbered if there are several, then their warnings, then the hints.

    A short answer has the first sentence of each warning, and its code alone where it would become
    too long. A full one has all sentences, and those of the rulers.

    Args:
        records: of one kind.
        hints: about the call.
        detail: short or full.
    """
    words = [_in_words(record) for record in records]
    if len(words) > 1:
        words = ["\n".join(f"{number}. {sentence}" for number, sentence in enumerate(words, 1))]
    if detail == "full" and isinstance(records[0], GsdEstimate):
        words += [ruler.explanation for ruler in records[0].rulers if ruler.explanation is not None]
    most = (
        _ESTIMATE_CHARS
        if isinstance(records[0], GsdEstimate)
        else _MEASUREMENT_CHARS * len(records)
    )
    warnings = _warnings(records, detail, most - len(" ".join([*words, *hints])))
    return Answer(
        " ".join([*words, *(f"{_PREFIX}{each}" for each in warnings), *hints]), (*warnings, *hints)
    )


def _warnings(records: Sequence[AnyRecord], detail: Detail, most_chars: int) -> list[str]:
    """List the warnings of records once each, with the targets that have them; the last names the rest."""
    found: dict[Notice, list[int]] = {}
    for number, record in enumerate(records, 1):
        for notice in record.warnings:
            found.setdefault(notice, []).append(number)
    names = [
        f"{notice.code}{'' if len(at) == len(records) else f' ({_targets(at)})'}"
        for notice, at in found.items()
    ]
    room = most_chars - len(f" {_PREFIX}{', '.join(names)}.")
    told = []
    rest = []
    for name, notice in zip(names, found, strict=True):
        message = notice.message if detail == "full" else brief(notice.message)
        extra = len(f" {_PREFIX}: {message}")
        if detail == "full" or extra <= room:
            room -= extra
            told.append(f"{name}: {message}")
        else:
            rest.append(name)
    return [*told, *([f"{', '.join(rest)}."] if rest else [])]


def _targets(numbers: Sequence[int]) -> str:
    return f"target{'' if len(numbers) == 1 else 's'} {', '.join(map(str, numbers))}"


# --- Records
#
# ---------------------------------------------------------------------------------------------------------


def _in_words(record: AnyRecord) -> str:
    if isinstance(record, GsdEstimate):
        return _estimate_in_words(record)
    return (
        _area_in_words(record)
        if isinstance(record, AreaMeasurement)
        else _distance_in_words(record)
    )


def _estimate_in_words(estimate: GsdEstimate) -> str:
    if estimate.gsd_m_per_px is None:
        words = [_no_scale(estimate).capitalize()]
    else:
        scale = f"{significant(estimate.gsd_m_per_px)} m/px"
        scale += _interval(estimate.gsd_ci95_low_m_per_px, estimate.gsd_ci95_high_m_per_px)
        words = [
            f"{scale}, confidence {estimate.confidence:.2f} from {ruler_names(estimate)}: "
            f"{_verdict(estimate)}"
        ]
    frame = estimate.frame
    if frame is not None and frame.gsd_m_per_px is not None:
        words.append(
            f"In your {frame.width_px} x {frame.height_px} copy that is "
            f"{significant(frame.gsd_m_per_px)} m/px."
        )
    if by_hand := by_hand_text(estimate):
        words.append(f"Vehicles corrected {by_hand}.")
    return " ".join(words)


def _area_in_words(area: AreaMeasurement) -> str:
    """Say the area and its status, the position of the mask and the choices of a point."""
    if not area.mask_area_px:
        return "No object found: no area. Draw a tight box around a visible object."
    if area.area_m2 is None:
        words = f"No area: the object covers {area.mask_area_px} px, but {_no_scale(area)}"
    else:
        size = (
            f"{significant(area.area_m2)} "
            f"m2{_interval(area.area_ci95_low_m2, area.area_ci95_high_m2)}"
        )
        if area.status == "ok" and area.length_m and area.width_m and area.inscribed_diameter_m:
            size += f", {significant(area.length_m)} x {significant(area.width_m)} m"
            size += f", largest circle inside {significant(area.inscribed_diameter_m)} m across"
        words = f"{size}; {_scale_origin(area)}: {_verdict(area)}"
    box, copy = (
        (area.bounding_box, "image") if area.frame is None else (area.frame.bounding_box, "copy")
    )
    if box is not None and not has_unknown_extent(area):
        span = f"x {box.x1_px:.0f} to {box.x2_px:.0f}, y {box.y1_px:.0f} to {box.y2_px:.0f}"
        words += f" Mask: {span} in your {copy}."
    others = map(_size, area.alternatives)
    return f"{words} Or you mean {' or '.join(others)}." if area.alternatives else words


def _size(other: OtherObject) -> str:
    return (
        f"{other.mask_area_px} px" if other.area_m2 is None else f"{significant(other.area_m2)} m2"
    )


def _distance_in_words(record: DistanceMeasurement) -> str:
    if record.distance_m is None:
        return f"No distance: the line is {record.length_px:.0f} px long, but {_no_scale(record)}"
    size = (
        f"{significant(record.distance_m)} "
        f"m{_interval(record.distance_ci95_low_m, record.distance_ci95_high_m)}"
    )
    return f"{size}; {_scale_origin(record)}: {_verdict(record)}"


def _interval(low: float | None, high: float | None) -> str:
    """Format an interval in brackets; empty without one."""
    return (
        ""
        if low is None or high is None
        else f" (95 % interval {significant(low)} to {significant(high)})"
    )


def _verdict(record: AnyRecord) -> str:
    """Say whether a record is usable; if not, say why and what would help."""
    if record.status == "ok":
        return "safe to use."
    return f"do not rely on it{_why(record)}; {advice_on(record)}."


def _no_scale(record: AnyRecord) -> str:
    """Say that there is no scale, why, and what would help."""
    return f"no ruler was found, confidence 0: no metric scale{_why(record)}; {advice_on(record)}."


def _why(record: AnyRecord) -> str:
    """Give the reason against a scale in brackets; empty without one."""
    advice = advice_for(record if isinstance(record, GsdEstimate) else record.estimate)
    return "" if advice is None else f" ({advice.why})"


def _scale_origin(measured: AreaMeasurement | DistanceMeasurement) -> str:
    """Name the source of a measurement's scale."""
    assert measured.gsd_m_per_px is not None
    source = "as stated" if measured.estimate is None else f"from {ruler_names(measured.estimate)}"
    confidence = f"scale confidence {measured.scale_confidence or 0.0:.2f}"
    return f"scale {significant(measured.gsd_m_per_px)} m/px {source}, {confidence}"
