"""Answers in words: the rule for planners, and the sentences of each record."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeAlias

from vehanchor.records import AreaMeasurement, DistanceMeasurement, GsdEstimate
from vehanchor.records.advice import advice_for
from vehanchor.records.contradiction import contradiction_of
from vehanchor.records.notices import NoticeCode
from vehanchor.records.text import (
    by_hand_text,
    file_source_text,
    fit_in_words,
    pixel_text,
    ruler_names,
    significant,
    with_capital,
)
from vehanchor.scale.defaults import INTERVAL_PREMISE
from vehanchor_server.calls.compact import brief, has_unknown_extent
from vehanchor_server.calls.remedies import advice_on

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.records import Notice, OtherObject
    from vehanchor_server.calls.reply import Detail

POLICY = (
    "Act on the scale only if status is ok: it is right within 20 % in at least 9 of 10 such "
    "photographs. Otherwise use another ruler. no_scale: no ruler was found, and gsd_m_per_px is "
    "null, never a guess."
)
"""The rule for planners in the description of ``estimate_gsd``."""

STATUS_RULES = (
    "Status ok: use the value, but compare the low end of its interval with what you need. "
    "low_confidence: do not act on the value. no_scale: the result is in pixels only. "
    "Scale arguments: see estimate_gsd; with more_images, it states the gsd values to give here."
)
"""The meaning of ``status`` in the descriptions of the measuring tools."""

AnyRecord: TypeAlias = GsdEstimate | AreaMeasurement | DistanceMeasurement

# Lengths of a short answer, per record; a token of a model has about four characters.
_ESTIMATE_CHARS = 320
_MEASUREMENT_CHARS = 520
_PREFIX = "Warning "
# Reasons about the image, whatever there is in it.
_WHOLE_IMAGE = ("no_photograph", "oblique")


class Answer(NamedTuple):
    """Answer in words.

    Attributes:
        text: all of it.
        warnings: those of the records and the hints, for the structured content.
    """

    text: str
    warnings: tuple[str, ...]


def answer_of(records: Sequence[AnyRecord], hints: Sequence[str], detail: Detail) -> Answer:
    """Describe the records of an image in words, then their warnings, then the hints.

    Several records are numbered. A short answer has the first sentence of each warning; where it
    would become too long, it has the warning's code alone. A full answer has all sentences, those
    of the rulers and of the remedies.

    Args:
        records: of one kind.
        hints: about the call.
        detail: short or full.
    """
    words = [_record_in_words(record) for record in records]
    if len(words) > 1:
        numbered = [f"{number}. {sentence}" for number, sentence in enumerate(words, 1)]
        words = ["\n".join(numbered)]
    first = records[0]
    contradiction = contradiction_of(first)
    stated_code = None
    if contradiction is not None:
        words = [f"{contradiction.text}.", *words]
        if detail == "short":
            stated_code = contradiction.code
    max_chars = _MEASUREMENT_CHARS * len(records)
    if isinstance(first, GsdEstimate):
        max_chars = _ESTIMATE_CHARS
    if detail == "full":
        words += _details_in_words(first)
    n_chars = len(" ".join([*words, *hints]))
    warnings = _warnings(records, detail, max_chars=max_chars - n_chars, stated_code=stated_code)
    prefixed = [f"{_PREFIX}{warning}" for warning in warnings]
    if contradiction is not None and stated_code is not None:
        warnings = [f"{stated_code}: {contradiction.text}.", *warnings]
    text = " ".join([*words, *prefixed, *hints])
    return Answer(text, (*warnings, *hints))


def _details_in_words(record: AnyRecord) -> list[str]:
    """State what each ruler measured, and what each remedy is expected to bring."""
    estimate = record if isinstance(record, GsdEstimate) else record.estimate
    if estimate is None:
        return []
    sentences = []
    for ruler in estimate.rulers:
        interval = _interval(ruler.gsd_ci95_low_m_per_px, ruler.gsd_ci95_high_m_per_px)
        scale = f"{significant(ruler.gsd_m_per_px)} m/px{interval}"
        label = with_capital(ruler.label)
        sentences.append(f"{label}: {scale}, right with a chance of {ruler.p_right:.2f}.")
        if ruler.explanation is not None:
            sentences.append(ruler.explanation)
    gains = [f"{gain.remedy} {gain.confidence:.2f}" for gain in estimate.details.remedies]
    if gains:
        sentences.append(f"Expected confidence by remedy: {', '.join(gains)}.")
    return sentences


def _warnings(
    records: Sequence[AnyRecord], detail: Detail, *, max_chars: int, stated_code: str | None
) -> list[str]:
    """List each warning of the records once, with the targets that have it.

    A short answer explains warnings while there is room, in their order; its last entry has the
    codes of the others.

    Args:
        records: as in ``answer_of``.
        detail: short or full.
        max_chars: room of a short answer.
        stated_code: code of the warning that the answer has begun with; None without one.
    """
    targets: dict[Notice, list[int]] = {}
    for number, record in enumerate(records, 1):
        for notice in record.warnings:
            if notice.code != stated_code:
                targets.setdefault(notice, []).append(number)
    names = []
    for notice, numbers in targets.items():
        is_about_all = len(numbers) == len(records)
        names.append(notice.code if is_about_all else f"{notice.code} ({_targets(numbers)})")
    # Each code appears, explained or not.
    room = max_chars - len(f" {_PREFIX}{', '.join(names)}.")
    explained = []
    unexplained = []
    for name, notice in zip(names, targets, strict=True):
        if detail == "full":
            explained.append(f"{name}: {notice.message}")
            continue
        message = brief(notice.message)
        n_chars = len(f" {_PREFIX}: {message}")
        if n_chars <= room:
            room -= n_chars
            explained.append(f"{name}: {message}")
        else:
            unexplained.append(name)
    if unexplained:
        codes = dict.fromkeys(unexplained)
        explained.append(f"{', '.join(codes)}.")
    return explained


def _targets(numbers: Sequence[int]) -> str:
    noun = "target" if len(numbers) == 1 else "targets"
    return f"{noun} {', '.join(map(str, numbers))}"


def _record_in_words(record: AnyRecord) -> str:
    if isinstance(record, GsdEstimate):
        return _estimate_in_words(record)
    if isinstance(record, AreaMeasurement):
        return _area_in_words(record)
    return _distance_in_words(record)


def _estimate_in_words(estimate: GsdEstimate) -> str:
    """State the scale, its confidence and verdict, and the corrections by hand."""
    if estimate.gsd_m_per_px is None:
        words = [_no_scale(estimate).capitalize()]
    else:
        interval = _interval(
            estimate.gsd_ci95_low_m_per_px, estimate.gsd_ci95_high_m_per_px, INTERVAL_PREMISE
        )
        words = [
            f"{significant(estimate.gsd_m_per_px)} m/px{interval}, "
            f"confidence {estimate.confidence:.2f} from {ruler_names(estimate)}: "
            f"{_verdict(estimate)}"
        ]
    pixel = pixel_text(estimate.gsd_m_per_px, estimate.details.pixel_aspect)
    if pixel:
        words.append(
            f"The image's pixels are not square: {pixel}. For lengths, use measure_distance."
        )
    frame = estimate.frame
    if frame is not None and frame.gsd_m_per_px is not None:
        words.append(
            f"In your {frame.width_px} x {frame.height_px} copy that is "
            f"{significant(frame.gsd_m_per_px)} m/px."
        )
    corrections = by_hand_text(estimate)
    if corrections:
        words.append(f"Vehicles corrected {corrections}.")
    file_gsd = estimate.georeference_gsd_m_per_px
    if file_gsd is not None and estimate.status != "ok" and contradiction_of(estimate) is None:
        words.append(
            f"The file's georeference gives {significant(file_gsd)} m/px: measure_area and "
            "measure_distance use it."
        )
    return " ".join(words)


def _area_in_words(area: AreaMeasurement) -> str:
    """State the area and its status, the position of the mask and the choices of a point."""
    if not area.mask_area_px:
        return "No object found: no area. Draw a tight box around a visible object."
    if area.area_m2 is None:
        words = f"No area: the object covers {area.mask_area_px} px, but {_no_scale(area)}"
    else:
        interval = _interval(area.area_ci95_low_m2, area.area_ci95_high_m2)
        size = f"{_at_least(area)}{significant(area.area_m2)} m2{interval}"
        # Beside the answer to must_fit, other sizes are not needed.
        is_asked = area.status == "ok" and area.fit is None
        if is_asked and area.length_m and area.width_m and area.inscribed_diameter_m:
            size += f", {significant(area.length_m)} x {significant(area.width_m)} m"
            size += f", largest circle inside {significant(area.inscribed_diameter_m)} m across"
        words = f"{size}; {_scale_origin(area)}: {_verdict(area)}"
    if area.fit is not None:
        words += f" {_fit_sentence(area)}"
    else:
        words += _mask_position(area)
    if area.alternatives:
        others = " or ".join(map(_size, area.alternatives))
        words += f" Or you mean {others}."
    return words


def _at_least(area: AreaMeasurement) -> str:
    """Begin an area that the image's edge cuts off; empty for a whole one."""
    is_cut = any(notice.code == NoticeCode.MASK_TOUCHES_EDGE for notice in area.warnings)
    return "At least " if is_cut else ""


def _fit_sentence(area: AreaMeasurement) -> str:
    """State whether the shape that must fit fits, and where."""
    fit = area.fit
    assert fit is not None
    words = fit_in_words(fit, has_scale=area.area_m2 is not None)
    sentence = with_capital(words)
    if area.status != "ok":
        return f"{sentence}: do not act on it."
    centre = fit.center
    place = "image"
    if area.frame is not None:
        centre = area.frame.fit_center
        place = "copy"
    if centre is not None:
        sentence += f", centre x {centre.x_px:.0f}, y {centre.y_px:.0f} in your {place}"
    if fit.heading_deg is not None:
        sentence += f", heading {fit.heading_deg:.0f} degrees"
    if area.inscribed_diameter_m:
        diameter = significant(area.inscribed_diameter_m)
        sentence += f"; the largest circle inside is {diameter} m across"
    return f"{sentence}."


def _mask_position(area: AreaMeasurement) -> str:
    """State the box of the mask in the caller's pixels; empty if the extent is unknown."""
    box = area.bounding_box
    place = "image"
    if area.frame is not None:
        box = area.frame.bounding_box
        place = "copy"
    if box is None or has_unknown_extent(area):
        return ""
    span = f"x {box.x1_px:.0f} to {box.x2_px:.0f}, y {box.y1_px:.0f} to {box.y2_px:.0f}"
    return f" Mask of {area.mask_area_px} px: {span} in your {place}."


def _size(other: OtherObject) -> str:
    if other.area_m2 is None:
        return f"{other.mask_area_px} px"
    return f"{significant(other.area_m2)} m2"


def _distance_in_words(record: DistanceMeasurement) -> str:
    if record.distance_m is None:
        return f"No distance: the line is {record.length_px:.0f} px long, but {_no_scale(record)}"
    interval = _interval(record.distance_ci95_low_m, record.distance_ci95_high_m)
    size = f"{significant(record.distance_m)} m{interval}"
    return f"{size}; {_scale_origin(record)}: {_verdict(record)}"


def _interval(low: float | None, high: float | None, premise: str = "") -> str:
    """Format an interval and its premise in brackets; empty without an interval."""
    if low is None or high is None:
        return ""
    interval = f"95 % interval {significant(low)} to {significant(high)} {premise}"
    return f" ({interval.rstrip()})"


def _verdict(record: AnyRecord) -> str:
    """State whether a record is usable; if not, state why and what would help."""
    if record.status == "ok":
        contradiction = contradiction_of(record)
        premise = "" if contradiction is None else contradiction.premise
        return f"safe to use {premise}".rstrip() + "."
    return f"do not rely on it{_why(record)}; {advice_on(record)}."


def _no_scale(record: AnyRecord) -> str:
    """State that there is no scale, why, and what would help."""
    estimate = record if isinstance(record, GsdEstimate) else getattr(record, "estimate", None)
    found = "no ruler was found, "
    if estimate is not None and estimate.reason in _WHOLE_IMAGE:
        found = ""
    return f"{found}confidence 0: no metric scale{_why(record)}; {advice_on(record)}."


def _why(record: AnyRecord) -> str:
    """Give the reason against a scale in brackets; empty without one."""
    estimate = record if isinstance(record, GsdEstimate) else record.estimate
    advice = advice_for(estimate)
    return "" if advice is None else f" ({advice.why})"


def _scale_origin(measured: AreaMeasurement | DistanceMeasurement) -> str:
    """Name the source of a measurement's scale."""
    assert measured.gsd_m_per_px is not None
    source = "as stated"
    if measured.scale_source == "file":
        source = f"by the file's georeference, {file_source_text(measured)}"
    elif measured.estimate is not None:
        source = f"from {ruler_names(measured.estimate)}"
    confidence = f"scale confidence {measured.scale_confidence or 0.0:.2f}"
    return f"scale {significant(measured.gsd_m_per_px)} m/px {source}, {confidence}"
