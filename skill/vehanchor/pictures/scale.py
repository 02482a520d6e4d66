"""The picture that says why: kept vehicles, dropped outliers and a scale bar over the image."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import cv2
import numpy as np

from vehanchor.detection.boxes import box_corners
from vehanchor.errors import OutputError
from vehanchor.imagery.raster import Window
from vehanchor.pictures.lettering import FONT, font_scale, stroke_px, text_px, text_width, write_on
from vehanchor.pictures.marks import MARK_RGB, draw_marks
from vehanchor.records.advice import ADVICE
from vehanchor.storage.atomic import whole_file

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster
    from vehanchor.pictures.drawable import DrawableScale
    from vehanchor.records import GsdEstimate

CaptionLine: TypeAlias = list[tuple[tuple[int, int, int] | None, str]]
"""Texts of one line, each with the colour of the swatch before it."""

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg")
KEPT_RGB = (86, 180, 233)  # Okabe and Ito's sky blue and orange: told apart with every kind of colour blindness
DROPPED_RGB = (230, 159, 0)
MIN_WIDTH_PX = 768  # smaller images are enlarged to it, so that text can be read
MAX_SIDE_PX = 2048  # larger ones are reduced to it: the picture is for eyes

_MIN_CANVAS_PX = 480  # a picture still narrower (of a tall, thin image) gets margins: the caption needs the room
_BAR_SHARE = 0.2  # of the picture's width, about what the scale bar takes
_HALO_MIN_PX = 22.0  # shorter vehicles, as drawn, would drown in the dark line beneath the coloured one
_SUBPIXEL_BITS = 4
_PANEL_RGB = (22, 24, 28)
_TEXT_RGB = (238, 238, 238)
_JPEG_QUALITY = 92
_ROWS_A_READ = 1024  # of the image, in strips as wide as it


def draw_overlay(image: NDArray[np.uint8], analysis: DrawableScale) -> NDArray[np.uint8]:
    """Draw what an estimate rests on: kept vehicles in blue, outliers crossed in orange, other rulers in green, a bar.

    The bar has a round length; rulers that were laid along something are drawn there. Small images are enlarged and
    large ones reduced; a caption below gives scale, interval and confidence. A scale that is not to be used has no bar,
    and the caption begins with why and what would help; nor has one of a camera that looked aside, which holds at the
    centre only.

    Args:
        image: ``[h, w, 3]`` RGB, the analysed image or a reduced copy of it (see ``read_reduced``).
        analysis: of that image.

    Returns:
        ``[h', w', 3]`` RGB, at most 2048 px a side before the caption is added.
    """
    estimate = analysis.estimate
    picture = fit_for_eyes(image)
    scale = np.array([picture.shape[1] / estimate.image_width_px, picture.shape[0] / estimate.image_height_px])
    draw_vehicles(picture, analysis, scale)
    draw_marks(picture, analysis.marks, scale)
    picture = with_margins(picture)
    if estimate.gsd_m_per_px is not None and estimate.status == "ok" and estimate.tilt is None:
        draw_scale_bar(picture, estimate.gsd_m_per_px / float(scale[0]))
    return np.concatenate([picture, caption_panel(picture.shape[1], _caption_lines(analysis))])


def fit_for_eyes(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A copy to draw into, enlarged where the image is small and reduced where it is large."""
    height, width = image.shape[:2]
    factor = _picture_factor(width, height)
    size = max(1, round(width * factor)), max(1, round(height * factor))
    if size == (width, height):
        return np.array(image)  # never the caller's own
    method = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    return cv2.resize(image, size, interpolation=method).astype(np.uint8, copy=False)


def read_reduced(raster: Raster, part: Window | None = None) -> NDArray[np.uint8]:
    """An image or a part of it, reduced so that no side is above 4096 px, without holding it in full size.

    Args:
        raster: the image.
        part: None for the whole.

    Returns:
        ``[h, w, 3]`` RGB, all of the part.
    """
    part = part or Window(0, 0, raster.width_px, raster.height_px)
    step = max(1, math.ceil(max(part.width_px, part.height_px) / (2 * MAX_SIDE_PX)))
    if step == 1:
        return raster.read(part)
    width, height = max(1, round(part.width_px / step)), max(1, round(part.height_px / step))
    reduced = np.empty((height, width, 3), np.uint8)
    for top in range(0, height, _ROWS_A_READ // step + 1):
        bottom = min(height, top + _ROWS_A_READ // step + 1)
        first, last = (round(row * part.height_px / height) for row in (top, bottom))
        strip = raster.read(Window(part.x_px, part.y_px + first, part.width_px, last - first))
        reduced[top:bottom] = cv2.resize(strip, (width, bottom - top), interpolation=cv2.INTER_AREA)
    return reduced


def check_picture_path(path: str | Path) -> Path:
    """Make sure that a picture can be written there, before the work of making it.

    Returns:
        The path.

    Raises:
        OutputError: the suffix is not .png, .jpg or .jpeg, or the folder does not exist.
    """
    target = Path(path)
    if target.suffix.lower() not in PICTURE_SUFFIXES:
        raise OutputError(
            f"cannot write a picture as {str(path)!r}: use one of the suffixes {', '.join(PICTURE_SUFFIXES)}"
        )
    if not target.parent.is_dir():
        raise OutputError(f"cannot write {str(path)!r}: there is no folder {str(target.parent)!r}; create it first")
    if target.is_dir():
        raise OutputError(f"cannot write {str(path)!r}: it is a folder; name a file")
    return target


def write_picture(path: str | Path, picture: NDArray[np.uint8]) -> Path:
    """Write a picture as PNG or JPEG, whichever the suffix says.

    Args:
        path: of the file, in a folder that exists.
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
        # Encoded in memory: OpenCV's own writer fails silently, and cannot open every path that Python can.
        partial.write_bytes(encoded.tobytes())
    return target


def _picture_factor(width_px: int, height_px: int) -> float:
    """How much larger the picture is drawn than the image."""
    longest = max(width_px, height_px)
    if longest > MAX_SIDE_PX:
        return MAX_SIDE_PX / longest
    return min(max(1.0, MIN_WIDTH_PX / width_px), MAX_SIDE_PX / longest)


def draw_vehicles(picture: NDArray[np.uint8], analysis: DrawableScale, scale: NDArray[np.float64]) -> None:
    """Kept vehicles in blue, dropped outliers crossed in orange; ``scale`` is pixels of the picture per image pixel."""
    boxes = analysis.detections.boxes
    if not len(boxes):
        return
    # Box coordinates count from the corner of the first pixel, OpenCV's from its centre.
    corners = box_corners(boxes) * scale - 0.5
    fixed_point = np.rint(corners * (1 << _SUBPIXEL_BITS)).astype(np.int32)
    drawn_length = float(np.median(boxes[:, 2]) * scale.mean())
    line = int(np.clip(round(min(max(picture.shape[:2]) / 500, drawn_length / 16)), 1, 3))
    kept, dropped = fixed_point[analysis.kept], fixed_point[~analysis.kept]
    crosses = np.ascontiguousarray(np.concatenate([dropped[:, [0, 2]], dropped[:, [1, 3]]]))
    layers = [(kept, True, KEPT_RGB, line), (dropped, True, DROPPED_RGB, line), (crosses, False, DROPPED_RGB, 1)]
    if drawn_length >= _HALO_MIN_PX:
        layers = [(fixed_point, True, _PANEL_RGB, line + 2), *layers]
    for shapes, closed, colour, thickness in layers:
        if len(shapes):
            cv2.polylines(picture, list(shapes), closed, colour, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)


def with_margins(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Room around a strip of an image for the scale bar and the caption."""
    across, down = _margins(picture.shape[1], picture.shape[0])
    if not across and not down:
        return picture
    sides = down // 2, down - down // 2, across // 2, across - across // 2
    return cv2.copyMakeBorder(picture, *sides, cv2.BORDER_CONSTANT, value=_PANEL_RGB).astype(np.uint8, copy=False)


def _margins(width_px: int, height_px: int) -> tuple[int, int]:
    """How many columns and rows a picture lacks."""
    across = max(0, _MIN_CANVAS_PX - width_px)
    return across, max(0, 5 * text_px(width_px + across) - height_px)


def _round_length(metres: float) -> float:
    """The nearest of 1, 2, 5 times a power of ten, nearest by ratio."""
    power = 10.0 ** math.floor(math.log10(metres))
    return min((m * power for m in (1.0, 2.0, 5.0, 10.0)), key=lambda length: abs(math.log(length / metres)))


def draw_scale_bar(picture: NDArray[np.uint8], m_per_px: float) -> None:
    """A bar of round length at the lower left, white with a black rim, its length above it."""
    height, width = picture.shape[:2]
    metres = _round_length(_BAR_SHARE * width * m_per_px)
    capital = text_px(width)
    margin, thick, rim = capital, max(4, capital // 2), max(2, capital // 7)
    left, bottom = margin, height - margin
    right = left + round(metres / m_per_px)
    for grow, colour in ((rim, (0, 0, 0)), (0, (255, 255, 255))):
        cv2.rectangle(picture, (left - grow, bottom - thick - grow), (right + grow, bottom + grow), colour, cv2.FILLED)
    write_on(picture, f"{metres:g} m", (left, bottom - thick - rim - capital // 2), capital)


def _headline(estimate: GsdEstimate) -> str:
    if estimate.gsd_m_per_px is None:
        return "no scale: nothing of known size found"
    low, high = estimate.gsd_ci95_low_m_per_px, estimate.gsd_ci95_high_m_per_px
    return with_interval(estimate.gsd_m_per_px, low, high, "m/px")


def with_interval(value: float, low: float | None, high: float | None, unit: str) -> str:
    """A quantity in words, with its interval where it has one."""
    interval = "" if low is None or high is None else f"  (95 %: {low:.4g} to {high:.4g})"
    return f"{value:.4g} {unit}{interval}"


def _caption_lines(analysis: DrawableScale) -> list[CaptionLine]:
    """Scale, interval and confidence, or first why there is none to use; the legend of both colours."""
    estimate = analysis.estimate
    n_dropped = estimate.n_detections - estimate.n_vehicles
    legend = [(KEPT_RGB, f"{estimate.n_vehicles} vehicle{'s' * (estimate.n_vehicles != 1)}")]
    if n_dropped:
        legend.append((DROPPED_RGB, f"{n_dropped} outlier{'s' * (n_dropped != 1)}, dropped"))
    scale = _headline(estimate)
    lines: list[CaptionLine]
    if estimate.reason is None:
        lines = [[(None, scale)], [(None, f"confidence {estimate.confidence:.2f}")]]
    else:
        why, helps = ADVICE[estimate.reason]
        lines = [[(None, f"no scale to use: {why}")], [(None, helps)]]
        if estimate.gsd_m_per_px is not None:
            lines.append([(None, f"{scale}, confidence {estimate.confidence:.2f}")])
    if estimate.tilt is not None:
        lines.append([(None, f"at the centre: the camera looked {estimate.tilt.tilt_deg:.0f} degrees aside")])
    if estimate.n_detections:
        lines.append([*legend])
    if said := _rulers_line(analysis):
        lines.append(said)
    return lines


def _rulers_line(analysis: DrawableScale) -> CaptionLine:
    """What each ruler says, behind a swatch where it was laid along something; nothing where vehicles are the only."""
    heard = [ruler for ruler in analysis.estimate.rulers if ruler.sets_scale]
    if [ruler.kind for ruler in heard] in ([], ["vehicles"]):
        return []
    marked = {other.kind for other in analysis.others if other.marks}
    return [
        (
            MARK_RGB if ruler.kind in marked else None,
            f"{ruler.label} {ruler.gsd_m_per_px:.3g} m/px{'' if ruler.agrees else ', disagrees'}",
        )
        for ruler in heard
    ]


def caption_panel(width_px: int, lines: list[CaptionLine]) -> NDArray[np.uint8]:
    """The panel below a picture: lines of texts, some behind a swatch of their colour; the first line is bold."""
    capital = float(text_px(width_px))
    while capital > 8 and max(_line_width(line, capital) for line in lines) > width_px - 2 * capital:
        capital -= 1
    pitch = round(2.1 * capital)
    panel = np.full((pitch * len(lines) + round(capital), width_px, 3), _PANEL_RGB, np.uint8)
    for row, line in enumerate(lines):
        x, baseline = round(capital), round(1.7 * capital) + row * pitch
        for colour, text in line:
            if colour is not None:
                side = round(capital)
                cv2.rectangle(panel, (x, baseline - side), (x + side, baseline), colour, cv2.FILLED)
                x += round(1.7 * capital)
            stroke = stroke_px(capital) + (row == 0)
            cv2.putText(panel, text, (x, baseline), FONT, font_scale(capital), _TEXT_RGB, stroke, cv2.LINE_AA)
            x += text_width(text, capital) + round(2 * capital)
    return panel


def _line_width(line: CaptionLine, capital_px: float) -> float:
    swatches = sum(1.7 * capital_px for colour, _ in line if colour is not None)
    return sum(text_width(text, capital_px) for _, text in line) + swatches + 2 * capital_px * (len(line) - 1)
