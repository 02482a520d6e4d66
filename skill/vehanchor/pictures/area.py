"""The picture of a measured object: its mask and outline, the prompt, the vehicles behind the scale, a scale bar."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.errors import OutputError
from vehanchor.pictures.marks import draw_marks
from vehanchor.pictures.scale import caption_panel, draw_scale_bar, draw_vehicles, fit_for_eyes, with_margins

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.findings import AreaFindings
    from vehanchor.options import ImageLimits
    from vehanchor.pictures.scale import CaptionLine
    from vehanchor.records import AreaMeasurement

__all__ = ["OUTLINE_RGB", "PROMPT_RGB", "draw_area", "full_mask"]

OUTLINE_RGB = (204, 121, 167)  # Okabe and Ito's reddish purple, beside the vehicles' sky blue and orange
PROMPT_RGB = (240, 228, 66)  # and yellow
_BESIDE_RGB = (213, 94, 0)
_TINT = 0.35
_SUBPIXEL_BITS = 4


def draw_area(image: NDArray[np.uint8], analysis: AreaFindings) -> NDArray[np.uint8]:
    """Draw what a measurement rests on, under a caption with area, scale and confidence.

    Args:
        image: ``[h, w, 3]`` RGB, the measured image or a reduced copy of it (see
            ``vehanchor.pictures.scale.read_reduced``).
        analysis: of that image.

    Returns:
        ``[h', w', 3]`` RGB, at most 2048 px a side before the caption is added.
    """
    record = analysis.measurement
    picture = fit_for_eyes(image)
    scale = np.array([picture.shape[1] / record.image_width_px, picture.shape[0] / record.image_height_px])
    if analysis.scale is not None:
        draw_vehicles(picture, analysis.scale, scale)
        draw_marks(picture, analysis.scale.marks, scale)
    _draw_mask(picture, analysis, scale)
    _draw_prompt(picture, analysis, scale)
    picture = with_margins(picture)
    if record.gsd_m_per_px is not None and (record.scale is None or record.scale.status == "ok"):
        draw_scale_bar(picture, record.gsd_m_per_px / float(scale[0]))
    return np.concatenate([picture, caption_panel(picture.shape[1], _caption_lines(record))])


def full_mask(analysis: AreaFindings, limits: ImageLimits) -> NDArray[np.uint8]:
    """The mask as large as the image: ``[h, w, 3]``, 255 on the object and 0 elsewhere.

    Raises:
        OutputError: the image has more pixels than may be held at once.
    """
    record = analysis.measurement
    width, height = record.image_width_px, record.image_height_px
    if width * height > limits.max_pixels:
        raise OutputError(
            f"cannot write a mask of {width} x {height} px, the limit is {limits.max_pixels} pixels: take the outline "
            "from the record"
        )
    window, mask = analysis.segmentation.window, analysis.segmentation.mask
    full = np.zeros((height, width, 3), np.uint8)
    full[window.y_px : window.y_px + window.height_px, window.x_px : window.x_px + window.width_px][mask] = 255
    return full


def _line_px(picture: NDArray[np.uint8]) -> int:
    return int(np.clip(round(max(picture.shape[:2]) / 500), 1, 3))


def _draw_mask(picture: NDArray[np.uint8], analysis: AreaFindings, scale: NDArray[np.float64]) -> None:
    """Tint the object and draw the line around it, from the mask itself: the record's outline is simplified."""
    mask, window = analysis.segmentation.mask, analysis.segmentation.window
    left, top = (round(at * factor) for at, factor in zip((window.x_px, window.y_px), scale, strict=True))
    right = round((window.x_px + window.width_px) * scale[0])
    bottom = round((window.y_px + window.height_px) * scale[1])
    if right <= left or bottom <= top:
        return
    share = cv2.resize(mask.view(np.uint8) * 255, (right - left, bottom - top), interpolation=cv2.INTER_AREA)
    shown = np.asarray(share > 127, dtype=np.uint8)
    region = picture[top:bottom, left:right]
    tint = np.array(OUTLINE_RGB, dtype=np.float64)
    region[shown > 0] = np.rint((1 - _TINT) * region[shown > 0] + _TINT * tint).astype(np.uint8)
    rings, _ = cv2.findContours(np.pad(shown, 1), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.polylines(
        picture,
        [ring + np.array([left - 1, top - 1], np.int32) for ring in rings],
        True,
        OUTLINE_RGB,
        _line_px(picture),
    )


def _draw_prompt(picture: NDArray[np.uint8], analysis: AreaFindings, scale: NDArray[np.float64]) -> None:
    prompt, line = analysis.prompt, _line_px(picture)
    fine = 1 << _SUBPIXEL_BITS
    if prompt.box is not None:
        # Prompts count from the corner of the first pixel, OpenCV from its centre.
        corners = np.rint((np.reshape(prompt.box, (2, 2)) * scale - 0.5) * fine).astype(int).tolist()
        cv2.rectangle(picture, corners[0], corners[1], PROMPT_RGB, 1, cv2.LINE_AA, _SUBPIXEL_BITS)
    for x, y, include in prompt.points:
        at = np.rint((np.array([x, y]) * scale - 0.5) * fine).astype(int).tolist()
        colour = PROMPT_RGB if include else _BESIDE_RGB
        cv2.circle(picture, at, 3 * line * fine, (0, 0, 0), cv2.FILLED, cv2.LINE_AA, _SUBPIXEL_BITS)
        cv2.circle(picture, at, 2 * line * fine, colour, cv2.FILLED, cv2.LINE_AA, _SUBPIXEL_BITS)


def _caption_lines(record: AreaMeasurement) -> list[CaptionLine]:
    if record.area_m2 is None:
        head = (
            f"{record.mask_area_px} px; no scale: nothing of known size found"
            if record.mask_area_px
            else "no object found"
        )
    else:
        head = f"{record.area_m2:.4g} m2"
        if record.area_ci95_low_m2 is not None and record.area_ci95_high_m2 is not None:
            head += f"  (95 %: {record.area_ci95_low_m2:.4g} to {record.area_ci95_high_m2:.4g})"
    lines: list[CaptionLine] = [[(OUTLINE_RGB, head)]]
    if record.gsd_m_per_px is not None:
        source = "given" if record.confidence is None else f"confidence {record.confidence:.2f}"
        low = " - low" if record.status == "low_confidence" else ""
        lines.append([(None, f"{record.gsd_m_per_px:.4g} m/px, {source}; mask score {record.mask_score:.2f}{low}")])
    return lines
