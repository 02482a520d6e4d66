"""Pictures of measured objects and lines, with the evidence of their scale and a caption."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.pictures.lettering import text_px, text_width, write_on
from vehanchor.pictures.marks import draw_marks
from vehanchor.pictures.placement import CUT_SIDE_PX, Cut, line_px, part_around
from vehanchor.pictures.scale import SAFE, UNSAFE, Canvas, open_canvas, safe_lines
from vehanchor.records.advice import advice_for
from vehanchor.records.notices import NoticeCode
from vehanchor.records.text import NO_SCALE, fit_in_words, significant, with_interval
from vehanchor.scale.defaults import USABLE_CHANCE
from vehanchor.scale.posterior import Mark

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.options.pixel_grid import PixelGrid
    from vehanchor.pictures.evidence import AreaEvidence, DistanceEvidence
    from vehanchor.pictures.placement import Colour, Placement, Points, RgbImage
    from vehanchor.pictures.scale import CaptionLine
    from vehanchor.records import AreaMeasurement, DistanceMeasurement
    from vehanchor.records.gsd_estimate import Status

# Okabe and Ito's reddish purple, beside the vehicles' sky blue and orange.
MEASURED_RGB = (204, 121, 167)
# Okabe and Ito's yellow.
PROMPT_RGB = (240, 228, 66)
# Okabe and Ito's vermilion, for points outside the object.
_OUTSIDE_RGB = (213, 94, 0)
# Okabe and Ito's bluish green, for the shape that must fit.
FIT_RGB = (0, 158, 115)
_CIRCLE_POINTS = 90
_BLACK = (0, 0, 0)
_TINT_OPACITY = 0.35
# Objects whose sizes the caption lists; more would be higher than the picture.
_MAX_CAPTIONS = 16


def draw_area(image: RgbImage, *analyses: AreaEvidence, cut: Cut | None = None) -> RgbImage:
    """Draw measured objects with their evidence.

    The caption gives area, mask, scale and confidence. Several objects are numbered. An enlarged
    cut shows the pixels of the masks.

    Args:
        image: see ``vehanchor.pictures.scale.draw_overlay``.
        analyses: analyses of objects in that image, one at least.
        cut: the part to show; None for all of the image.

    Returns:
        ``[h', w', 3]`` RGB, at most 2048 px a side before the caption is added.
    """
    first = analyses[0]
    canvas = open_canvas(image, first, scale=first.scale, cut=cut)
    for analysis in analyses:
        _draw_mask(canvas.picture, analysis, canvas.placement)
        _draw_prompt(canvas.picture, analysis, canvas.placement)
        _draw_fit(canvas.picture, analysis.measurement, canvas.placement, analysis.grid)
    numbers = _numbered([""] * len(analyses))
    for number, analysis in zip(numbers, analyses, strict=True):
        if number:
            _write_number(canvas, number, analysis)
    sizes = [_area_text(analysis.measurement) for analysis in analyses[:_MAX_CAPTIONS]]
    if len(analyses) > _MAX_CAPTIONS:
        sizes.append(f"and {len(analyses) - _MAX_CAPTIONS} more")
    statuses = [analysis.measurement.status for analysis in analyses]
    return _finish(canvas, first, sizes, statuses=statuses)


def cut_to_objects(analyses: Sequence[AreaEvidence]) -> Cut:
    """Cut the image to measured objects and their prompts."""
    points = np.concatenate([_extent(analysis) for analysis in analyses])
    part = part_around(points, analyses[0].whole_image)
    return Cut(part, CUT_SIDE_PX)


def _extent(analysis: AreaEvidence) -> Points:
    """Return points that span the mask and the prompt, ``[n, 2]`` square pixels of the image."""
    prompt = analysis.prompt
    points = [(x, y) for x, y, _ in prompt.points]
    if prompt.box is not None:
        x1, y1, x2, y2 = prompt.box
        points += [(x1, y1), (x2, y2)]
    mask_box = analysis.segmentation.bounding_box
    if mask_box is not None:
        x1, y1, x2, y2 = mask_box
        points += [(x1, y1), (x2, y2)]
    return np.array(points, dtype=np.float64)


def draw_distance(image: RgbImage, *analyses: DistanceEvidence, cut: Cut | None = None) -> RgbImage:
    """Draw measured lines with their evidence.

    The caption gives length, scale and confidence. A usable length is also written beside the
    middle of its line. Several lines are numbered. Arguments and result are those of ``draw_area``.
    """
    first = analyses[0]
    canvas = open_canvas(image, first, scale=first.scale, cut=cut)
    records = [analysis.measurement for analysis in analyses]
    labels = _numbered([_line_label(record) for record in records])
    lines = []
    for analysis, label in zip(analyses, labels, strict=True):
        points = tuple((x, y) for x, y in analysis.path.tolist())
        lines.append(Mark(points, label))
    draw_marks(canvas.picture, lines, canvas.placement, colour=MEASURED_RGB)
    sizes = [_distance_text(record) for record in records]
    return _finish(canvas, first, sizes, statuses=[record.status for record in records])


def cut_to_lines(analyses: Sequence[DistanceEvidence]) -> Cut:
    """Cut the image to measured lines."""
    points = np.concatenate([analysis.path for analysis in analyses])
    part = part_around(points, analyses[0].whole_image)
    return Cut(part, CUT_SIDE_PX)


def _draw_mask(picture: RgbImage, analysis: AreaEvidence, placement: Placement) -> None:
    """Tint the object and draw its outline.

    Both come from the mask, because the record's outline is simplified.
    """
    mask = analysis.segmentation.mask
    window = analysis.segmentation.window
    image_right = window.x_px + window.width_px
    image_bottom = window.y_px + window.height_px
    corners = [(window.x_px, window.y_px), (image_right, image_bottom)]
    in_picture = np.rint(placement.to_picture(corners)).astype(int)
    (left, top), (right, bottom) = in_picture.tolist()
    # The part of the mask's window that the picture shows.
    height, width = picture.shape[:2]
    x1 = max(0, left)
    y1 = max(0, top)
    x2 = min(width, right)
    y2 = min(height, bottom)
    if x2 <= x1 or y2 <= y1:
        return
    # A reduced pixel belongs to the object if more than half of it does.
    size = (right - left, bottom - top)
    method = cv2.INTER_NEAREST
    if right - left < window.width_px:
        method = cv2.INTER_AREA
    opaque = mask.view(np.uint8) * 255
    coverage = cv2.resize(opaque, size, interpolation=method)
    rows = slice(y1 - top, y2 - top)
    columns = slice(x1 - left, x2 - left)
    is_object = np.asarray(coverage[rows, columns] > 127)
    region = picture[y1:y2, x1:x2]
    tint = np.array(MEASURED_RGB, dtype=np.float64)
    pixels = region[is_object]
    tinted = (1 - _TINT_OPACITY) * pixels + _TINT_OPACITY * tint
    region[is_object] = np.rint(tinted).astype(np.uint8)
    # The padding closes outlines at the border of the region.
    padded = np.pad(is_object.astype(np.uint8), 1)
    rings, _ = cv2.findContours(padded, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    origin = np.array([x1 - 1, y1 - 1], np.int32)
    cv2.polylines(
        picture,
        [ring + origin for ring in rings],
        isClosed=True,
        color=MEASURED_RGB,
        thickness=line_px(picture),
    )


def _draw_prompt(picture: RgbImage, analysis: AreaEvidence, placement: Placement) -> None:
    prompt = analysis.prompt
    line = line_px(picture)
    if prompt.box is not None:
        corners = placement.to_opencv(np.reshape(prompt.box, (2, 2)))
        first, last = corners.tolist()
        cv2.rectangle(
            picture,
            first,
            last,
            color=PROMPT_RGB,
            thickness=1,
            lineType=cv2.LINE_AA,
        )
    for x, y, include in prompt.points:
        centre = placement.to_opencv([x, y]).tolist()
        colour = PROMPT_RGB if include else _OUTSIDE_RGB
        # A dot with a black rim.
        _draw_dot(picture, centre, 3 * line, colour=_BLACK)
        _draw_dot(picture, centre, 2 * line, colour=colour)


def _draw_fit(
    picture: RgbImage, record: AreaMeasurement, placement: Placement, grid: PixelGrid
) -> None:
    """Draw the shape that must fit at its best place, in its own size."""
    fit = record.fit
    gsd = record.gsd_m_per_px
    if fit is None or fit.center is None or gsd is None:
        return
    places = [(point.x_px, point.y_px) for point in (fit.center, *fit.corners)]
    centre, *corners = grid.to_square(places).tolist()
    if fit.diameter_m is not None:
        corners = _circle(centre, fit.diameter_m / gsd)
    if not corners:
        return
    points = placement.to_opencv(np.array(corners)).reshape(-1, 1, 2)
    for colour, thickness in ((_BLACK, 3), (FIT_RGB, 1)):
        cv2.polylines(
            picture,
            [points],
            isClosed=True,
            color=colour,
            thickness=thickness * line_px(picture),
            lineType=cv2.LINE_AA,
        )


def _circle(centre: Sequence[float], diameter_px: float) -> list[tuple[float, float]]:
    """List points of a circle, square pixels of the image."""
    x_px, y_px = centre
    angles = np.linspace(0, 2 * np.pi, _CIRCLE_POINTS, endpoint=False)
    xs = x_px + diameter_px / 2 * np.cos(angles)
    ys = y_px + diameter_px / 2 * np.sin(angles)
    return list(zip(xs.tolist(), ys.tolist(), strict=True))


def _draw_dot(picture: RgbImage, centre: Sequence[int], radius: int, *, colour: Colour) -> None:
    cv2.circle(
        picture,
        centre,
        radius,
        color=colour,
        thickness=cv2.FILLED,
        lineType=cv2.LINE_AA,
    )


def _write_number(canvas: Canvas, number: str, analysis: AreaEvidence) -> None:
    """Write an object's number on its middle."""
    capital = text_px(canvas.picture.shape[1])
    extent = canvas.placement.to_picture(_extent(analysis))
    x, y = extent.mean(0).tolist()
    left = round(x) - text_width(number, capital) // 2
    baseline = round(y) + capital // 2
    write_on(canvas.picture, number, (left, baseline), capital_px=capital)


def _area_text(record: AreaMeasurement) -> str:
    if not record.mask_area_px:
        return "no object found"
    low = record.area_ci95_low_m2
    high = record.area_ci95_high_m2
    mask = f"{record.mask_area_px} px"
    missing = f"{mask}; {NO_SCALE}"
    size = with_interval(record.area_m2, low, high=high, unit="m2", missing=missing)
    pixels = "" if record.area_m2 is None else f"{mask}, "
    codes = {notice.code for notice in record.warnings}
    doubt = " - low" if NoticeCode.MASK_SCORE_LOW in codes else ""
    text = f"{size}; {pixels}shape given"
    if record.mask_score is not None:
        text = f"{size}; mask {pixels}score {record.mask_score:.2f}{doubt}"
    if record.fit is not None:
        text += f"; {fit_in_words(record.fit, has_scale=record.area_m2 is not None)}"
    return text


def _line_label(record: DistanceMeasurement) -> str:
    """Return a usable length as a label; empty for any other."""
    if record.status != "ok" or record.distance_m is None:
        return ""
    return f"{significant(record.distance_m)} m"


def _distance_text(record: DistanceMeasurement) -> str:
    return with_interval(
        record.distance_m,
        record.distance_ci95_low_m,
        high=record.distance_ci95_high_m,
        unit="m",
        missing=f"{record.length_px:.0f} px; {NO_SCALE}",
    )


def _finish(
    canvas: Canvas,
    analysis: AreaEvidence | DistanceEvidence,
    sizes: Sequence[str],
    *,
    statuses: Sequence[Status],
) -> RgbImage:
    """Add the caption: whether the sizes are usable, the sizes, and the scale.

    A scale that is unusable, or holds at one place only because of a tilt, has no scale bar.
    """
    record = analysis.measurement
    objection = _objection(record)
    verdict = _verdict(objection, statuses)
    lines: list[CaptionLine] = [[(None, verdict)]]
    if verdict == SAFE:
        lines = safe_lines(record)
    lines += [[(MEASURED_RGB, size)] for size in _numbered(sizes)]
    if record.gsd_m_per_px is not None:
        source = "given"
        if record.scale_confidence is not None:
            source = f"confidence {record.scale_confidence:.2f}"
        scale = significant(record.gsd_m_per_px, 4)
        lines.append([(None, f"{scale} m/px, {source}")])
    bar_gsd = None
    if analysis.nadir and not objection:
        bar_gsd = record.gsd_m_per_px
    return canvas.finished(bar_gsd, lines)


def _numbered(labels: Sequence[str]) -> list[str]:
    """Put numbers before the labels of several measurements; keep a single label."""
    if len(labels) == 1:
        return list(labels)
    numbered = []
    for number, label in enumerate(labels, 1):
        numbered.append(f"{number}: {label}" if label else f"{number}")
    return numbered


def _verdict(objection: str, statuses: Sequence[Status]) -> str:
    """State whether the sizes are usable, or which of them are not, and why.

    Args:
        objection: what speaks against the scale, which all have; empty for nothing.
        statuses: status of each measurement.
    """
    if objection:
        return f"{UNSAFE}: {objection}"
    if "no_scale" in statuses:
        return f"{UNSAFE}: {NO_SCALE}"
    doubted = [number for number, status in enumerate(statuses, 1) if status != "ok"]
    if not doubted:
        return SAFE
    doubt = "check the outline, or draw a tighter one"
    if len(doubted) == len(statuses):
        return f"{UNSAFE}: {doubt}"
    numbers = ", ".join(str(number) for number in doubted)
    return f"{SAFE}, but not {numbers}: {doubt}"


def _objection(record: AreaMeasurement | DistanceMeasurement) -> str:
    """Explain why the scale is not usable; empty for a usable scale and without one."""
    if record.gsd_m_per_px is None or record.scale_confidence is None:
        return ""
    if record.scale_confidence >= USABLE_CHANCE:
        return ""
    advice = advice_for(record.estimate)
    if advice is None:
        return f"the scale's confidence is below {USABLE_CHANCE}"
    return advice.why
