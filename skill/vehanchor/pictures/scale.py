"""Picture of an estimate: the image with its vehicles, outliers, other rulers and a scale bar."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import cv2
import numpy as np

from vehanchor.detection.boxes import box_corners
from vehanchor.imagery.raster import Window
from vehanchor.pictures.lettering import put_text, stroke_px, text_px, text_width, write_on
from vehanchor.pictures.marks import MARK_RGB, draw_marks
from vehanchor.pictures.placement import Cut, Placement, line_px
from vehanchor.records.advice import advice_for
from vehanchor.records.contradiction import contradiction_of
from vehanchor.records.text import by_hand_text, count, scale_text, significant
from vehanchor.storage.atomic import check_output_path, whole_file

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.detection.detections import Detections
    from vehanchor.imagery.raster import Raster
    from vehanchor.pictures.evidence import Evidence, ScaleEvidence
    from vehanchor.pictures.placement import Colour, RgbImage
    from vehanchor.records import AreaMeasurement, DistanceMeasurement, GsdEstimate

    Pixel: TypeAlias = tuple[int, int]
    """Column and row."""

CaptionLine: TypeAlias = "list[tuple[Colour | None, str]]"
"""Texts of one line, each with the colour of the swatch before it."""

SAFE = "safe to use"
UNSAFE = "do not use"
"""First words of a caption."""

PICTURE_SUFFIXES = (".png", ".jpg", ".jpeg")
# Okabe and Ito's sky blue and orange, distinct with every colour blindness.
KEPT_RGB = (86, 180, 233)
DROPPED_RGB = (230, 159, 0)
# Smaller images are enlarged, so that text is legible. Larger ones are reduced for display.
MIN_WIDTH_PX = 768
MAX_SIDE_PX = 2048

# Narrower pictures (of tall, thin images) get margins for the caption.
_MIN_CANVAS_PX = 480
# Approximate length of the scale bar as a share of the picture's width.
_BAR_SHARE = 0.2
# Capitals of vehicles' numbers: share of a vehicle's drawn width, and limits in pixels.
_NUMBER_SHARE = 0.5
_NUMBER_RANGE_PX = (8, 16)
# Distance of a number from its vehicle.
_NUMBER_GAP_PX = 3
# Largest share of a number that lies on vehicles.
_MAX_COVERED_SHARE = 0.3
# More vehicles than that have no numbers if they are drawn shorter.
_MANY_VEHICLES = 100
_NUMBERED_PX = 30.0
# Vehicles drawn at least this long have a dark line under the coloured one.
_MIN_HALO_PX = 22.0
# Drawn length of a vehicle over the width of its lines.
_LENGTH_PER_LINE = 16
_PANEL_RGB = (22, 24, 28)
_TEXT_RGB = (238, 238, 238)
_MIN_CAPTION_CAPITAL_PX = 8
# Dimensions of the caption in heights of its capitals.
_LINE_PITCH = 2.1
_FIRST_BASELINE = 1.7
_SWATCH_WIDTH = 1.7
_TEXT_GAP = 2
_JPEG_QUALITY = 92
# Rows of the image that are read at a time.
_ROWS_PER_STRIP = 1024


def draw_overlay(image: RgbImage, analysis: ScaleEvidence, cut: Cut | None = None) -> RgbImage:
    """Draw the evidence of an estimate over its image.

    Kept vehicles are blue, outliers orange with a cross, other rulers green. Small images are
    enlarged and large ones reduced.

    A caption below begins with whether the scale is usable, and gives scale, interval and
    confidence. For an unusable scale it also has the reason and advice. A usable scale has a scale
    bar of round length, unless the camera was tilted: then the scale holds at the centre only.

    Args:
        image: ``[h, w, 3]`` RGB, the analysed image, the part of ``cut``, or a reduced copy of
            either (see ``read_reduced``).
        analysis: analysis of that image.
        cut: the part to show; None for all of the image.

    Returns:
        ``[h', w', 3]`` RGB, at most 2048 px a side before the caption is added.
    """
    estimate = analysis.estimate
    canvas = open_canvas(image, analysis, scale=analysis, cut=cut)
    bar_gsd = None
    if estimate.status == "ok" and estimate.tilt is None:
        bar_gsd = estimate.gsd_m_per_px
    return canvas.finished(bar_gsd, _caption_lines(analysis))


class Canvas(NamedTuple):
    """Picture to draw into.

    Attributes:
        picture: ``[h, w, 3]`` RGB, a copy of the image at display size.
        placement: position of the image in the picture.
    """

    picture: RgbImage
    placement: Placement

    def finished(self, gsd_m_per_px: float | None, lines: list[CaptionLine]) -> RgbImage:
        """Add a scale bar and the caption, and margins to a narrow picture.

        Args:
            gsd_m_per_px: scale for a scale bar; None draws no bar.
            lines: caption.

        Returns:
            ``[h', w', 3]`` RGB.
        """
        height, width = self.picture.shape[:2]
        across = max(0, _MIN_CANVAS_PX - width)
        min_height = 5 * text_px(width + across)
        down = max(0, min_height - height)
        bordered = cv2.copyMakeBorder(
            self.picture,
            top=down // 2,
            bottom=down - down // 2,
            left=across // 2,
            right=across - across // 2,
            borderType=cv2.BORDER_CONSTANT,
            value=_PANEL_RGB,
        )
        picture = np.asarray(bordered, dtype=np.uint8)
        if gsd_m_per_px is not None:
            enlargement = float(self.placement.scale[0])
            draw_scale_bar(picture, gsd_m_per_px / enlargement)
        panel = caption_panel(picture.shape[1], lines)
        return np.concatenate([picture, panel])


def open_canvas(
    image: RgbImage,
    evidence: Evidence,
    scale: ScaleEvidence | None,
    cut: Cut | None,
) -> Canvas:
    """Copy an image at display size and draw the evidence of its scale.

    Args:
        image: ``[h, w, 3]`` RGB, the analysed image, the part of ``cut``, or a reduced copy of
            either.
        evidence: evidence of that image.
        scale: analysis of the scale; None without one.
        cut: the part to show; None for all of the image.
    """
    if cut is None:
        picture = fit_for_eyes(image)
        part = evidence.whole_image
    else:
        picture = cut.sized(image)
        part = cut.part
    placement = Placement.of(picture, part)
    if scale is not None:
        draw_vehicles(picture, scale, placement)
        draw_marks(picture, scale.marks, placement)
    return Canvas(picture, placement)


def fit_for_eyes(image: RgbImage) -> RgbImage:
    """Copy an image at display size: small ones are enlarged, large ones reduced."""
    height, width = image.shape[:2]
    whole = Cut(Window(0, 0, width_px=width, height_px=height), MAX_SIDE_PX)
    max_enlargement = max(1.0, MIN_WIDTH_PX / width)
    return whole.sized(image, max_enlargement, cv2.INTER_CUBIC)


def read_reduced(raster: Raster, part: Window | None = None) -> RgbImage:
    """Read an image or a part of it in strips, reduced so that no side exceeds 4096 px.

    Args:
        raster: the image.
        part: window of the image; None for all of it.

    Returns:
        ``[h, w, 3]`` RGB, all of the part.
    """
    if part is None:
        part = Window(0, 0, width_px=raster.width_px, height_px=raster.height_px)
    longer_side = max(part.width_px, part.height_px)
    max_side_px = 2 * MAX_SIDE_PX
    reduction = max(1, math.ceil(longer_side / max_side_px))
    if reduction == 1:
        return raster.read(part)
    width = max(1, round(part.width_px / reduction))
    height = max(1, round(part.height_px / reduction))
    reduced = np.empty((height, width, 3), np.uint8)
    # In strips: the full image may not fit in memory.
    rows_per_strip = _ROWS_PER_STRIP // reduction + 1
    for top in range(0, height, rows_per_strip):
        bottom = min(height, top + rows_per_strip)
        first_row = round(top * part.height_px / height)
        last_row = round(bottom * part.height_px / height)
        strip = Window(
            part.x_px,
            part.y_px + first_row,
            width_px=part.width_px,
            height_px=last_row - first_row,
        )
        size = (width, bottom - top)
        pixels = raster.read(strip)
        reduced[top:bottom] = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    return reduced


def check_picture_path(path: str | Path) -> Path:
    """Check that a picture can be written to a path, before it is drawn.

    Returns:
        The path.

    Raises:
        OutputError: the suffix is not .png, .jpg or .jpeg, or the folder does not exist.
    """
    return check_output_path(path, PICTURE_SUFFIXES, kind="a picture")


def write_picture(path: str | Path, picture: RgbImage) -> Path:
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
    parameters = []
    if suffix != ".png":
        parameters = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    bgr = np.ascontiguousarray(picture[:, :, ::-1])
    # Encoded in memory: OpenCV's own writer fails silently and cannot open all paths.
    _, encoded = cv2.imencode(suffix, bgr, parameters)
    with whole_file(target) as partial:
        partial.write_bytes(encoded.tobytes())
    return target


def draw_vehicles(picture: RgbImage, analysis: ScaleEvidence, placement: Placement) -> None:
    """Draw kept vehicles in blue, outliers crossed in orange, and their numbers.

    Args:
        picture: drawn into.
        analysis: analysis of the image.
        placement: position of the image in the picture.
    """
    boxes = analysis.detections.boxes
    if not len(boxes):
        return
    corners = placement.to_opencv(box_corners(boxes))
    median_length = np.median(boxes[:, 2])
    drawn_length = float(median_length * placement.scale.mean())
    line = line_px(picture, drawn_length / _LENGTH_PER_LINE)
    if drawn_length >= _MIN_HALO_PX:
        _draw_shapes(picture, corners, colour=_PANEL_RGB, line=line + 2)
    kept = corners[analysis.kept]
    dropped = corners[~analysis.kept]
    # The diagonals of the dropped boxes.
    falling = dropped[:, [0, 2]]
    rising = dropped[:, [1, 3]]
    crosses = np.concatenate([falling, rising])
    _draw_shapes(picture, kept, colour=KEPT_RGB, line=line)
    _draw_shapes(picture, dropped, colour=DROPPED_RGB, line=line)
    _draw_shapes(picture, crosses, closed=False, colour=DROPPED_RGB, line=1)
    _write_numbers(picture, analysis.detections, placement)


def _draw_shapes(
    picture: RgbImage,
    shapes: NDArray[np.int32],
    *,
    colour: Colour,
    line: int,
    closed: bool = True,
) -> None:
    """Draw polygons ``[n, corners, 2]``, or open lines."""
    if len(shapes):
        cv2.polylines(
            picture,
            list(np.ascontiguousarray(shapes)),
            isClosed=closed,
            color=colour,
            thickness=line,
            lineType=cv2.LINE_AA,
        )


def _write_numbers(picture: RgbImage, detections: Detections, placement: Placement) -> None:
    """Write each vehicle's number beside it, best first, unless all places there are taken.

    A number covers no other number and hardly a vehicle, because whoever reads it judges by the
    picture whether the box holds a car. Many small vehicles have no numbers.
    """
    enlargement = placement.scale.mean()
    if len(detections.boxes) > _MANY_VEHICLES:
        median_length = np.median(detections.boxes[:, 2])
        if median_length * enlargement < _NUMBERED_PX:
            return
    corners = placement.to_opencv(box_corners(detections.boxes))
    is_vehicle = np.zeros(picture.shape[:2], np.uint8)
    for shape in corners:
        cv2.fillConvexPoly(is_vehicle, shape, 1)
    is_written = np.zeros(picture.shape[:2], np.uint8)
    for box, shape, number in zip(detections.boxes, corners, detections.numbers, strict=True):
        text = str(number)
        fitting = _NUMBER_SHARE * box[3] * enlargement
        capital = int(np.clip(fitting, *_NUMBER_RANGE_PX))
        size = (text_width(text, capital), capital)
        place = _free_place(shape, size, is_vehicle, is_written)
        if place is not None:
            left, top = place
            is_written[top : top + capital, left : left + size[0]] = 1
            write_on(picture, text, (left, top + capital), capital_px=capital)


def _free_place(
    corners: NDArray[np.int32],
    size: Pixel,
    is_vehicle: NDArray[np.uint8],
    is_written: NDArray[np.uint8],
) -> Pixel | None:
    """Find the place beside a vehicle whose label covers least of any vehicle.

    Args:
        corners: ``[4, 2]`` corners of its box in the picture.
        size: width and height of the label.
        is_vehicle: ``[h, w]`` 1 where a vehicle is.
        is_written: ``[h, w]`` 1 where a label is.

    Returns:
        Left and top of the label; None if no place is inside the picture and free.
    """
    width, height = size
    left, top = (corners.min(axis=0) - _NUMBER_GAP_PX).tolist()
    right, bottom = (corners.max(axis=0) + _NUMBER_GAP_PX).tolist()
    middle_x = (left + right - width) // 2
    middle_y = (top + bottom - height) // 2
    places = [
        (right, middle_y),
        (left - width, middle_y),
        (middle_x, top - height),
        (middle_x, bottom),
        (right - width, top - height),
        (left, top - height),
        (right - width, bottom),
        (left, bottom),
    ]
    # Beside the sides of a slanted box, where its bounding box has room.
    middles = (corners + np.roll(corners, -1, axis=0)) / 2
    outwards = middles - corners.mean(axis=0)
    lengths = np.linalg.norm(outwards, axis=1, keepdims=True)
    directions = outwards / np.maximum(lengths, 1.0)
    label = np.array([width, height])
    reach = _NUMBER_GAP_PX + np.abs(directions) @ label / 2
    centres = middles + directions * reach[:, None]
    corners_beside = np.rint(centres - label / 2).astype(int)
    beside = [(x, y) for x, y in corners_beside.tolist()]
    places = [*beside, *places]
    best = None
    least_covered = _MAX_COVERED_SHARE * width * height
    picture_height, picture_width = is_vehicle.shape
    for x, y in places:
        if x < 0 or y < 0 or x + width > picture_width or y + height > picture_height:
            continue
        region = (slice(y, y + height), slice(x, x + width))
        covered = int(is_vehicle[region].sum())
        if covered < least_covered and not is_written[region].any():
            least_covered = covered
            best = (x, y)
    return best


def _round_length(metres: float) -> float:
    """Round to 1, 2 or 5 times a power of ten, nearest by ratio."""
    power = 10.0 ** math.floor(math.log10(metres))
    lengths = [multiple * power for multiple in (1.0, 2.0, 5.0, 10.0)]

    def log_distance(length: float) -> float:
        return abs(math.log(length / metres))

    return min(lengths, key=log_distance)


def draw_scale_bar(picture: RgbImage, m_per_px: float) -> None:
    """Draw a labelled bar of round length at the lower left, white with a black rim."""
    height, width = picture.shape[:2]
    metres = _round_length(_BAR_SHARE * width * m_per_px)
    capital = text_px(width)
    margin = capital
    thickness = max(4, capital // 2)
    rim = max(2, capital // 7)
    left = margin
    right = left + round(metres / m_per_px)
    bottom = height - margin
    top = bottom - thickness
    black = (0, 0, 0)
    white = (255, 255, 255)
    outer_first = (left - rim, top - rim)
    outer_last = (right + rim, bottom + rim)
    _fill_rectangle(picture, outer_first, outer_last, colour=black)
    _fill_rectangle(picture, (left, top), (right, bottom), colour=white)
    start = (left, top - rim - capital // 2)
    write_on(picture, f"{metres:g} m", start, capital_px=capital)


def _fill_rectangle(picture: RgbImage, first: Pixel, last: Pixel, *, colour: Colour) -> None:
    """Fill a rectangle between two corner pixels, both included."""
    cv2.rectangle(picture, first, last, color=colour, thickness=cv2.FILLED)


def _caption_lines(analysis: ScaleEvidence) -> list[CaptionLine]:
    """Compose the caption: an objection to an unusable scale, scale, confidence and legend."""
    estimate = analysis.estimate
    scale = scale_text(estimate)
    confidence = f"confidence {estimate.confidence:.2f}"
    lines: list[CaptionLine]
    advice = advice_for(estimate)
    if advice is None:
        lines = [*safe_lines(estimate), [(None, f"{scale}, {confidence}")]]
    else:
        objection = f"{UNSAFE}: {advice.why}"
        lines = [[(None, objection)], [(None, advice.helps)]]
        if estimate.gsd_m_per_px is not None:
            lines.append([(None, f"{scale}, {confidence}")])
    if estimate.tilt is not None:
        tilt_deg = estimate.tilt.tilt_deg
        lines.append([(None, f"at the centre: the camera was tilted by {tilt_deg:.0f} degrees")])
    if estimate.details.n_detections:
        lines.append(_vehicles_line(estimate))
    rulers = _rulers_line(analysis)
    if rulers:
        lines.append(rulers)
    return lines


def safe_lines(
    record: GsdEstimate | AreaMeasurement | DistanceMeasurement,
) -> list[CaptionLine]:
    """Begin the caption of a usable result: its premise, and both scales of a contradiction."""
    contradiction = contradiction_of(record)
    if contradiction is None:
        return [[(None, SAFE)]]
    verdict = f"{SAFE} {contradiction.premise}".rstrip()
    return [[(None, verdict)], [(None, contradiction.text)]]


def _vehicles_line(estimate: GsdEstimate) -> CaptionLine:
    """Count the kept and dropped vehicles, with swatches as a legend."""
    n_detected = estimate.details.n_detections or 0
    n_kept = estimate.n_vehicles or 0
    n_dropped = n_detected - n_kept
    kept = count(n_kept, "vehicle")
    by_hand = by_hand_text(estimate)
    if by_hand:
        kept = f"{kept} ({by_hand})"
    line: CaptionLine = [(KEPT_RGB, kept)]
    if n_dropped:
        line.append((DROPPED_RGB, f"{count(n_dropped, 'outlier')}, dropped"))
    return line


def _rulers_line(analysis: ScaleEvidence) -> CaptionLine:
    """List the rulers' scales, with a swatch for those with marks.

    The list is empty if vehicles are the only ruler.
    """
    rulers = [ruler for ruler in analysis.estimate.rulers if ruler.sets_scale]
    if all(ruler.kind == "vehicles" for ruler in rulers):
        return []
    marked = {witness.kind for witness in analysis.witnesses if witness.marks}
    line: CaptionLine = []
    for ruler in rulers:
        swatch = MARK_RGB if ruler.kind in marked else None
        doubt = "" if ruler.probably_right else ", probably wrong"
        scale = significant(ruler.gsd_m_per_px)
        line.append((swatch, f"{ruler.label} {scale} m/px{doubt}"))
    return line


def caption_panel(width_px: int, lines: list[CaptionLine]) -> RgbImage:
    """Draw the panel below a picture: lines of text with swatches; the first line is bold.

    A text that is too long for the smallest letters is broken between words.
    """
    rows = []
    for number, line in enumerate(lines):
        is_bold = number == 0
        rows += [_Row(part, is_bold) for part in _broken(_Row(line, is_bold), width_px)]
    capital = _fitting_capital(width_px, rows)
    margin = round(capital)
    pitch = round(_LINE_PITCH * capital)
    first_baseline = round(_FIRST_BASELINE * capital)
    height_px = pitch * len(rows) + margin
    panel = np.full((height_px, width_px, 3), _PANEL_RGB, np.uint8)
    for number, row in enumerate(rows):
        x = margin
        baseline = first_baseline + number * pitch
        stroke = row.stroke_px(capital)
        for colour, text in row.line:
            if colour is not None:
                side = round(capital)
                first = (x, baseline - side)
                last = (x + side, baseline)
                _fill_rectangle(panel, first, last, colour=colour)
                x += round(_SWATCH_WIDTH * capital)
            put_text(
                panel,
                text,
                (x, baseline),
                capital_px=capital,
                colour=_TEXT_RGB,
                stroke=stroke,
            )
            x += text_width(text, capital, stroke) + round(_TEXT_GAP * capital)
    return panel


class _Row(NamedTuple):
    """Row of a caption.

    Attributes:
        line: its texts.
        is_bold: whether its letters are bold, and broader.
    """

    line: CaptionLine
    is_bold: bool

    def stroke_px(self, capital_px: float) -> int:
        """Width of its strokes, pixels, for a height of capitals."""
        return stroke_px(capital_px) + int(self.is_bold)

    def width(self, capital_px: float) -> float:
        """Width in pixels, for a height of capitals."""
        swatches = 0.0
        texts = 0
        for colour, text in self.line:
            texts += text_width(text, capital_px, self.stroke_px(capital_px))
            if colour is not None:
                swatches += _SWATCH_WIDTH * capital_px
        gaps = _TEXT_GAP * capital_px * (len(self.line) - 1)
        return texts + swatches + gaps

    def fits(self, width_px: int, capital_px: float) -> bool:
        """Test whether it fits between two margins."""
        return self.width(capital_px) <= width_px - 2 * capital_px


def _broken(row: _Row, width_px: int) -> list[CaptionLine]:
    """Break a text that is too long for the smallest letters into lines that suit usual ones."""
    if len(row.line) > 1 or row.fits(width_px, _MIN_CAPTION_CAPITAL_PX):
        return [row.line]
    [(swatch, text)] = row.line
    capital = text_px(width_px)
    lines: list[CaptionLine] = []
    for word in text.split():
        if lines:
            [(colour, begun)] = lines[-1]
            longer: CaptionLine = [(colour, f"{begun} {word}")]
            if row._replace(line=longer).fits(width_px, capital):
                lines[-1] = longer
                continue
        lines.append([(None if lines else swatch, word)])
    return lines


def _fitting_capital(width_px: int, rows: list[_Row]) -> float:
    """Find the height of capitals, pixels, at which all rows fit."""
    capital = float(text_px(width_px))
    while capital > _MIN_CAPTION_CAPITAL_PX:
        if all(row.fits(width_px, capital) for row in rows):
            break
        capital -= 1
    return capital
