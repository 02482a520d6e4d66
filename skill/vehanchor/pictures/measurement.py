"""Pictures of measured objects and lines: masks, outlines, prompts, lengths, vehicles and scale bar."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.pictures.lettering import text_px, text_width, write_on
from vehanchor.pictures.marks import draw_marks
from vehanchor.pictures.placement import CUT_SIDE_PX, Cut, line_px, part_around
from vehanchor.pictures.scale import Canvas, open_canvas
from vehanchor.records.notices import NoticeCode
from vehanchor.records.text import ADVICE, NO_SCALE, significant, with_interval
from vehanchor.scale.defaults import USABLE_CHANCE
from vehanchor.scale.posterior import Mark

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.pictures.evidence import AreaEvidence, DistanceEvidence
    from vehanchor.pictures.placement import Placement
    from vehanchor.pictures.scale import CaptionLine
    from vehanchor.records import AreaMeasurement, DistanceMeasurement

# Okabe and Ito's reddish purple, beside the vehicles' sky blue and orange
MEASURED_RGB = (204, 121, 167)
PROMPT_RGB = (240, 228, 66)  # Okabe and Ito's yellow
_OUTSIDE_RGB = (213, 94, 0)  # Okabe and Ito's vermilion, for points outside the object
_TINT = 0.35


def draw_area(
    image: NDArray[np.uint8], *analyses: AreaEvidence, cut: Cut | None = None
) -> NDArray[np.uint8]:
    """Draw measured objects with their evidence and a caption with area, mask, scale and confidence.

    Several objects are numbered. A cut that is enlarged shows the pixels of the masks.

    Args:
        image: as in ``vehanchor.pictures.scale.draw_overlay``.
        analyses: of objects in that image, one at least.
        cut: the part to show; None for all of the image.

    Returns:
        ``[h', w', 3]`` RGB, at most 2048 px a side before the caption is added.
    """
    canvas = open_canvas(image, analyses[0].measurement, scale=analyses[0].scale, cut=cut)
    for analysis in analyses:
        _draw_mask(canvas.picture, analysis, canvas.place)
        _draw_prompt(canvas.picture, analysis, canvas.place)
    for label, analysis in zip(_numbered([""] * len(analyses)), analyses, strict=True):
        _write_number(canvas.picture, label, analysis=analysis, place=canvas.place)
    return _finished(
        canvas, analyses[0], [_area_text(analysis.measurement) for analysis in analyses]
    )


def cut_to_objects(analyses: Sequence[AreaEvidence], long_side_px: int = CUT_SIDE_PX) -> Cut:
    """Cut the image to measured objects and their prompts."""
    points = np.concatenate([_extent(analysis) for analysis in analyses])
    record = analyses[0].measurement
    return Cut(part_around(points, record.image_width_px, record.image_height_px), long_side_px)


def _extent(analysis: AreaEvidence) -> NDArray[np.float64]:
    """Return points that span the mask and the prompt, ``[n, 2]`` pixels of the image."""
    prompt = analysis.prompt
    box = analysis.measurement.bounding_box
    points = [(x, y) for x, y, _ in prompt.points]
    if prompt.box is not None:
        points += [(prompt.box[0], prompt.box[1]), (prompt.box[2], prompt.box[3])]
    if box is not None:
        points += [(box.x1_px, box.y1_px), (box.x2_px, box.y2_px)]
    return np.array(points, dtype=np.float64)


def draw_distance(
    image: NDArray[np.uint8], *analyses: DistanceEvidence, cut: Cut | None = None
) -> NDArray[np.uint8]:
    """Draw measured lines with their evidence and a caption with length, scale and confidence.

    A usable length is also written beside the middle of its line. Several lines are numbered.
    Arguments and result are those of ``draw_area``.
    """
    canvas = open_canvas(image, analyses[0].measurement, scale=analyses[0].scale, cut=cut)
    records = [analysis.measurement for analysis in analyses]
    labels = _numbered([_label(record) for record in records])
    lines = [Mark(_ends(record), label) for record, label in zip(records, labels, strict=True)]
    draw_marks(canvas.picture, lines, place=canvas.place, colour=MEASURED_RGB)
    return _finished(canvas, analyses[0], [_distance_text(record) for record in records])


def cut_to_lines(records: Sequence[DistanceMeasurement], long_side_px: int = CUT_SIDE_PX) -> Cut:
    """Cut the image to measured lines."""
    points = np.array([end for record in records for end in _ends(record)])
    return Cut(
        part_around(points, records[0].image_width_px, records[0].image_height_px), long_side_px
    )


def _draw_mask(picture: NDArray[np.uint8], analysis: AreaEvidence, place: Placement) -> None:
    """Tint the object and draw its outline, both from the mask, because the record's outline is simplified."""
    mask = analysis.segmentation.mask
    window = analysis.segmentation.window
    corners = place.at(
        [
            [window.x_px, window.y_px],
            [window.x_px + window.width_px, window.y_px + window.height_px],
        ]
    )
    (left, top), (right, bottom) = np.rint(corners).astype(int).tolist()
    height, width = picture.shape[:2]
    x1 = max(0, left)
    y1 = max(0, top)
    x2 = min(width, right)
    y2 = min(height, bottom)
    if x2 <= x1 or y2 <= y1:
        return
    method = cv2.INTER_AREA if right - left < window.width_px else cv2.INTER_NEAREST
    share = cv2.resize(
        mask.view(np.uint8) * 255, (right - left, bottom - top), interpolation=method
    )
    shown = np.asarray(share[y1 - top : y2 - top, x1 - left : x2 - left] > 127, dtype=np.uint8)
    region = picture[y1:y2, x1:x2]
    tint = np.array(MEASURED_RGB, dtype=np.float64)
    region[shown > 0] = np.rint((1 - _TINT) * region[shown > 0] + _TINT * tint).astype(np.uint8)
    rings, _ = cv2.findContours(np.pad(shown, 1), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    at = np.array([x1 - 1, y1 - 1], np.int32)
    cv2.polylines(picture, [ring + at for ring in rings], True, MEASURED_RGB, line_px(picture))


def _draw_prompt(picture: NDArray[np.uint8], analysis: AreaEvidence, place: Placement) -> None:
    prompt = analysis.prompt
    line = line_px(picture)
    if prompt.box is not None:
        corners = place.pixels(np.reshape(prompt.box, (2, 2))).tolist()
        cv2.rectangle(picture, corners[0], corners[1], PROMPT_RGB, 1, cv2.LINE_AA)
    for x, y, include in prompt.points:
        at = place.pixels([x, y]).tolist()
        colour = PROMPT_RGB if include else _OUTSIDE_RGB
        cv2.circle(picture, at, 3 * line, (0, 0, 0), cv2.FILLED, cv2.LINE_AA)
        cv2.circle(picture, at, 2 * line, colour, cv2.FILLED, cv2.LINE_AA)


def _write_number(
    picture: NDArray[np.uint8], number: str, analysis: AreaEvidence, place: Placement
) -> None:
    """Write an object's number on its middle; nothing for a single object."""
    if number:
        capital = text_px(picture.shape[1])
        x, y = place.at(_extent(analysis)).mean(0).tolist()
        write_on(
            picture,
            number,
            at=(round(x) - text_width(number, capital) // 2, round(y) + capital // 2),
            capital_px=capital,
        )


def _area_text(record: AreaMeasurement) -> str:
    if not record.mask_area_px:
        return "no object found"
    low = record.area_ci95_low_m2
    high = record.area_ci95_high_m2
    mask = f"{record.mask_area_px} px"
    size = with_interval(record.area_m2, low, high=high, unit="m2", missing=f"{mask}; {NO_SCALE}")
    pixels = "" if record.area_m2 is None else f"{mask}, "
    low_score = any(notice.code == NoticeCode.MASK_SCORE_LOW for notice in record.warnings)
    return f"{size}; mask {pixels}score {record.mask_score:.2f}{' - low' if low_score else ''}"


def _ends(record: DistanceMeasurement) -> tuple[tuple[float, float], ...]:
    return tuple((point.x_px, point.y_px) for point in record.path)


def _label(record: DistanceMeasurement) -> str:
    usable = record.status == "ok" and record.distance_m is not None
    return f"{significant(record.distance_m or 0)} m" if usable else ""


def _distance_text(record: DistanceMeasurement) -> str:
    low = record.distance_ci95_low_m
    high = record.distance_ci95_high_m
    return with_interval(
        record.distance_m,
        low,
        high=high,
        unit="m",
        missing=f"{record.length_px:.0f} px; {NO_SCALE}",
    )


def _finished(
    canvas: Canvas, analysis: AreaEvidence | DistanceEvidence, sizes: Sequence[str]
) -> NDArray[np.uint8]:
    """Add the caption with sizes and scale, a reason against their use first; no bar for a tilted or unusable scale."""
    record = analysis.measurement
    objection = _objection(record)
    lines: list[CaptionLine] = [[(None, f"do not use: {objection}")]] if objection else []
    lines += [[(MEASURED_RGB, size)] for size in _numbered(sizes)]
    if record.gsd_m_per_px is not None:
        source = (
            "given"
            if record.scale_confidence is None
            else f"confidence {record.scale_confidence:.2f}"
        )
        lines.append([(None, f"{significant(record.gsd_m_per_px, 4)} m/px, {source}")])
    return canvas.finished(record.gsd_m_per_px if analysis.nadir and not objection else None, lines)


def _numbered(labels: Sequence[str]) -> list[str]:
    """Put numbers before the labels of several measurements; keep a single label."""
    if len(labels) == 1:
        return list(labels)
    return [f"{number}: {label}".removesuffix(": ") for number, label in enumerate(labels, 1)]


def _objection(record: AreaMeasurement | DistanceMeasurement) -> str:
    """Explain why the scale is not usable; empty for a usable scale and without one."""
    if (
        record.scale_confidence is None
        or record.gsd_m_per_px is None
        or record.scale_confidence >= USABLE_CHANCE
    ):
        return ""
    reason = None if record.estimate is None else record.estimate.reason
    return (
        f"the scale's confidence is below {USABLE_CHANCE}" if reason is None else ADVICE[reason].why
    )
