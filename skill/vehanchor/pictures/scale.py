"""Picture of an estimate: kept vehicles, dropped outliers, other rulers and a scale bar over the image."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import cv2
import numpy as np

from vehanchor.detection.boxes import box_corners
from vehanchor.imagery.raster import Window
from vehanchor.pictures.lettering import FONT, font_scale, stroke_px, text_px, text_width, write_on
from vehanchor.pictures.marks import MARK_RGB, draw_marks
from vehanchor.pictures.placement import Cut, Placement, line_px
from vehanchor.records.text import advice_for, by_hand_text, count, scale_text, significant
from vehanchor.storage.atomic import check_output_path, whole_file

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.detection.detections import Detections
    from vehanchor.imagery.raster import Raster
    from vehanchor.pictures.evidence import ScaleEvidence
    from vehanchor.records import AreaMeasurement, DistanceMeasurement, GsdEstimate

CaptionLine: TypeAlias = list[tuple[tuple[int, int, int] | None, str]]
"""Texts of one line, each with the colour of the swatch before it."""

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg")
# Okabe and Ito's sky blue and orange, distinct with every colour blindness
KEPT_RGB = (86, 180, 233)
DROPPED_RGB = (230, 159, 0)
MIN_WIDTH_PX = 768  # smaller images are enlarged, so that text is legible
MAX_SIDE_PX = 2048  # larger images are reduced for display

_MIN_CANVAS_PX = 480  # narrower pictures (of tall, thin images) get margins for the caption
_BAR_SHARE = 0.2  # approximate length of the scale bar as a share of the picture's width
# capitals of vehicles' numbers: share of a drawn width, and pixels
_NUMBER_SHARE = 0.5
_NUMBER_RANGE_PX = (8, 16)
# more vehicles than that, drawn shorter, have no numbers
_MANY_VEHICLES = 100
_NUMBERED_PX = 30.0
_HALO_MIN_PX = 22.0  # least drawn length of vehicles for a dark line under the coloured one
_PANEL_RGB = (22, 24, 28)
_TEXT_RGB = (238, 238, 238)
_JPEG_QUALITY = 92
_ROWS_PER_READ = 1024  # rows of the image per strip


def draw_overlay(
    image: NDArray[np.uint8], analysis: ScaleEvidence, cut: Cut | None = None
) -> NDArray[np.uint8]:
    """Draw the evidence of an estimate: kept vehicles in blue, outliers crossed in orange, other rulers in green.

    Small images are enlarged and large ones reduced. A caption below gives scale, interval and
    confidence. A usable scale has a scale bar of round length, unless the camera was tilted: then
    the scale holds at the centre only. For an unusable scale the caption begins with the reason and
    with advice.

    Args:
        image: ``[h, w, 3]`` RGB, the analysed image, the part of ``cut``, or a reduced copy of
            either (see ``read_reduced``).
        analysis: of that image.
        cut: the part to show; None for all of the image.

    Returns:
        ``[h', w', 3]`` RGB, at most 2048 px a side before the caption is added.
    """
    estimate = analysis.estimate
    canvas = open_canvas(image, estimate, scale=analysis, cut=cut)
    bar = estimate.gsd_m_per_px if estimate.status == "ok" and estimate.tilt is None else None
    return canvas.finished(bar, _caption_lines(analysis))


class Canvas(NamedTuple):
    """Picture to draw into.

    Attributes:
        picture: ``[h, w, 3]`` RGB, a copy of the image at display size.
        place: of the image in the picture.
    """

    picture: NDArray[np.uint8]
    place: Placement

    def finished(self, gsd_m_per_px: float | None, lines: list[CaptionLine]) -> NDArray[np.uint8]:
        """Add margins to a narrow picture, a scale bar for a scale, and the caption: ``[h', w', 3]`` RGB."""
        height, width = self.picture.shape[:2]
        across = max(0, _MIN_CANVAS_PX - width)
        down = max(0, 5 * text_px(width + across) - height)
        sides = down // 2, down - down // 2, across // 2, across - across // 2
        picture = np.asarray(
            cv2.copyMakeBorder(self.picture, *sides, cv2.BORDER_CONSTANT, value=_PANEL_RGB),
            dtype=np.uint8,
        )
        if gsd_m_per_px is not None:
            draw_scale_bar(picture, gsd_m_per_px / float(self.place.scale[0]))
        return np.concatenate([picture, caption_panel(picture.shape[1], lines)])


def open_canvas(
    image: NDArray[np.uint8],
    record: GsdEstimate | AreaMeasurement | DistanceMeasurement,
    scale: ScaleEvidence | None,
    cut: Cut | None,
) -> Canvas:
    """Copy an image at display size and draw the evidence of its scale.

    Args:
        image: ``[h, w, 3]`` RGB, the analysed image, the part of ``cut``, or a reduced copy of
            either.
        record: of that image.
        scale: analysis of the scale; None without one.
        cut: the part to show; None for all of the image.
    """
    picture = fit_for_eyes(image) if cut is None else cut.sized(image)
    whole = Window(0, 0, width_px=record.image_width_px, height_px=record.image_height_px)
    place = Placement.of(picture, whole if cut is None else cut.part)
    if scale is not None:
        draw_vehicles(picture, scale, place)
        draw_marks(picture, scale.marks, place)
    return Canvas(picture, place)


def fit_for_eyes(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Copy an image at display size: small ones are enlarged, large ones reduced."""
    height, width = image.shape[:2]
    whole = Cut(Window(0, 0, width_px=width, height_px=height), MAX_SIDE_PX)
    return whole.sized(image, max(1.0, MIN_WIDTH_PX / width), cv2.INTER_CUBIC)


def read_reduced(raster: Raster, part: Window | None = None) -> NDArray[np.uint8]:
    """Read an image or a part of it in strips, reduced so that no side exceeds 4096 px.

    Args:
        raster: the image.
        part: window of the image; None for all of it.

    Returns:
        ``[h, w, 3]`` RGB, all of the part.
    """
    part = part or Window(0, 0, width_px=raster.width_px, height_px=raster.height_px)
    step = max(1, math.ceil(max(part.width_px, part.height_px) / (2 * MAX_SIDE_PX)))
    if step == 1:
        return raster.read(part)
    width = max(1, round(part.width_px / step))
    height = max(1, round(part.height_px / step))
    reduced = np.empty((height, width, 3), np.uint8)
    for top in range(0, height, _ROWS_PER_READ // step + 1):
        bottom = min(height, top + _ROWS_PER_READ // step + 1)
        first, last = (round(row * part.height_px / height) for row in (top, bottom))
        strip = raster.read(
            Window(part.x_px, part.y_px + first, width_px=part.width_px, height_px=last - first)
        )
        reduced[top:bottom] = cv2.resize(strip, (width, bottom - top), interpolation=cv2.INTER_AREA)
    return reduced


def check_picture_path(path: str | Path) -> Path:
    """Check that a picture can be written to a path, before it is drawn.

    Returns:
        The path.

    Raises:
        OutputError: the suffix is not .png, .jpg or .jpeg, or the folder does not exist.
    """
    return check_output_path(path, PICTURE_SUFFIXES, kind="a picture")


def write_picture(path: str | Path, picture: NDArray[np.uint8]) -> Path:
    """Write a picture as PNG or JPEG, by the suffix.

    Args:
        path: path of the file, in an existing folder.
        picture: ``[h, w, 3]`` RGB.

    Returns:
        The path.

    Raises:
        OutputError: see ``check_picture_path``; or the file system refuses.
    """
    target = check_picture_path(path)
    suffix = target.suffix.lower()
    quality = [] if suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    _, encoded = cv2.imencode(suffix, np.ascontiguousarray(picture[:, :, ::-1]), quality)
    with whole_file(target) as partial:
        # Encoded in memory: OpenCV's own writer fails silently and cannot open all paths.
        partial.write_bytes(encoded.tobytes())
    return target


def draw_vehicles(picture: NDArray[np.uint8], analysis: ScaleEvidence, place: Placement) -> None:
    """Draw kept vehicles in blue, outliers crossed in orange, and their numbers.

    Args:
        picture: drawn into.
        analysis: of the image.
        place: of the image in the picture.
    """
    boxes = analysis.detections.boxes
    if not len(boxes):
        return
    corners = place.pixels(box_corners(boxes))
    drawn_length = float(np.median(boxes[:, 2]) * place.scale.mean())
    line = line_px(picture, drawn_length / 16)
    kept = corners[analysis.kept]
    dropped = corners[~analysis.kept]
    crosses = np.ascontiguousarray(np.concatenate([dropped[:, [0, 2]], dropped[:, [1, 3]]]))
    layers = [
        (kept, True, KEPT_RGB, line),
        (dropped, True, DROPPED_RGB, line),
        (crosses, False, DROPPED_RGB, 1),
    ]
    if drawn_length >= _HALO_MIN_PX:
        layers = [(corners, True, _PANEL_RGB, line + 2), *layers]
    for shapes, closed, colour, thickness in layers:
        if len(shapes):
            cv2.polylines(picture, list(shapes), closed, colour, thickness, cv2.LINE_AA)
    _write_numbers(picture, analysis.detections, place)


def _write_numbers(picture: NDArray[np.uint8], detections: Detections, place: Placement) -> None:
    """Write each vehicle's number on it, best first, unless it covers another number; none on many small vehicles."""
    if (
        len(detections.boxes) > _MANY_VEHICLES
        and np.median(detections.boxes[:, 2]) * place.scale.mean() < _NUMBERED_PX
    ):
        return
    written = np.zeros(picture.shape[:2], bool)
    for box, number in zip(detections.boxes, detections.numbers, strict=True):
        text = str(number)
        (x, y) = place.at(box[:2])
        capital = int(np.clip(_NUMBER_SHARE * box[3] * place.scale.mean(), *_NUMBER_RANGE_PX))
        width = text_width(text, capital)
        left = round(x - width / 2)
        baseline = round(y + capital / 2)
        covered = written[
            max(0, baseline - capital) : max(0, baseline), max(0, left) : max(0, left + width)
        ]
        if covered.size and not covered.any():
            covered[:] = True
            write_on(picture, text, at=(left, baseline), capital_px=capital)


def _round_length(metres: float) -> float:
    """Round to 1, 2 or 5 times a power of ten, nearest by ratio."""
    power = 10.0 ** math.floor(math.log10(metres))
    return min(
        (m * power for m in (1.0, 2.0, 5.0, 10.0)),
        key=lambda length: abs(math.log(length / metres)),
    )


def draw_scale_bar(picture: NDArray[np.uint8], m_per_px: float) -> None:
    """Draw a labelled bar of round length at the lower left, white with a black rim."""
    height, width = picture.shape[:2]
    metres = _round_length(_BAR_SHARE * width * m_per_px)
    capital = text_px(width)
    margin = capital
    thick = max(4, capital // 2)
    rim = max(2, capital // 7)
    left = margin
    bottom = height - margin
    right = left + round(metres / m_per_px)
    for grow, colour in ((rim, (0, 0, 0)), (0, (255, 255, 255))):
        cv2.rectangle(
            picture,
            (left - grow, bottom - thick - grow),
            (right + grow, bottom + grow),
            colour,
            cv2.FILLED,
        )
    write_on(
        picture, f"{metres:g} m", at=(left, bottom - thick - rim - capital // 2), capital_px=capital
    )


def _caption_lines(analysis: ScaleEvidence) -> list[CaptionLine]:
    """Compose the caption: the reason against an unusable scale, scale, interval, confidence, and the legend."""
    estimate = analysis.estimate
    n_found = estimate.details.n_detections or 0
    n_kept = estimate.n_vehicles or 0
    n_dropped = n_found - n_kept
    by_hand = by_hand_text(estimate)
    legend = [(KEPT_RGB, f"{count(n_kept, 'vehicle')}{by_hand and f' ({by_hand})'}")]
    if n_dropped:
        legend.append((DROPPED_RGB, f"{count(n_dropped, 'outlier')}, dropped"))
    scale = scale_text(estimate)
    lines: list[CaptionLine]
    advice = advice_for(estimate)
    if advice is None:
        lines = [[(None, scale)], [(None, f"confidence {estimate.confidence:.2f}")]]
    else:
        lines = [[(None, f"no usable scale: {advice.why}")], [(None, advice.helps)]]
        if estimate.gsd_m_per_px is not None:
            lines.append([(None, f"{scale}, confidence {estimate.confidence:.2f}")])
    if estimate.tilt is not None:
        lines.append(
            [
                (
                    None,
                    f"at the centre: the camera was tilted by {estimate.tilt.tilt_deg:.0f} degrees",
                )
            ]
        )
    if n_found:
        lines.append([*legend])
    if rulers := _rulers_line(analysis):
        lines.append(rulers)
    return lines


def _rulers_line(analysis: ScaleEvidence) -> CaptionLine:
    """List the rulers' scales, with a swatch for those with marks; empty if vehicles are the only ruler."""
    rulers = [ruler for ruler in analysis.estimate.rulers if ruler.sets_scale]
    if [ruler.kind for ruler in rulers] in ([], ["vehicles"]):
        return []
    marked = {each.kind for each in analysis.witnesses if each.marks}
    return [
        (
            MARK_RGB if ruler.kind in marked else None,
            f"{ruler.label} {significant(ruler.gsd_m_per_px)} "
            f"m/px{'' if ruler.probably_right else ', probably wrong'}",
        )
        for ruler in rulers
    ]


def caption_panel(width_px: int, lines: list[CaptionLine]) -> NDArray[np.uint8]:
    """Draw the panel below a picture: lines of text with colour swatches; the first line is bold."""
    capital = float(text_px(width_px))
    while (
        capital > 8 and max(_line_width(line, capital) for line in lines) > width_px - 2 * capital
    ):
        capital -= 1
    pitch = round(2.1 * capital)
    panel = np.full((pitch * len(lines) + round(capital), width_px, 3), _PANEL_RGB, np.uint8)
    for row, line in enumerate(lines):
        x = round(capital)
        baseline = round(1.7 * capital) + row * pitch
        for colour, text in line:
            if colour is not None:
                side = round(capital)
                cv2.rectangle(panel, (x, baseline - side), (x + side, baseline), colour, cv2.FILLED)
                x += round(1.7 * capital)
            stroke = stroke_px(capital) + (row == 0)
            cv2.putText(
                panel,
                text,
                (x, baseline),
                FONT,
                font_scale(capital),
                _TEXT_RGB,
                stroke,
                cv2.LINE_AA,
            )
            x += text_width(text, capital) + round(2 * capital)
    return panel


def _line_width(line: CaptionLine, capital_px: float) -> float:
    swatches = sum(1.7 * capital_px for colour, _ in line if colour is not None)
    return (
        sum(text_width(text, capital_px) for _, text in line)
        + swatches
        + 2 * capital_px * (len(line) - 1)
    )
