"""Picture of a measured object: mask, outline, prompt, vehicles and scale bar."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.errors import OutputError
from vehanchor.pictures.measured import MEASURED_RGB, finish, open_canvas, size_in_words
from vehanchor.scale.thresholds import FALLBACK_CONFIDENCE

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.pictures.drawable import DrawableArea
    from vehanchor.records import AreaMeasurement

PROMPT_RGB = (240, 228, 66)  # Okabe and Ito's yellow
_OUTSIDE_RGB = (213, 94, 0)  # Okabe and Ito's vermilion, for points outside the object
_TINT = 0.35
_SUBPIXEL_BITS = 4


def draw_area(image: NDArray[np.uint8], analysis: DrawableArea) -> NDArray[np.uint8]:
    """Draw an area measurement with its evidence and a caption with area, scale and confidence.

    Args:
        image: ``[h, w, 3]`` RGB, the measured image or a reduced copy of it (see
            ``vehanchor.pictures.scale.read_reduced``).
        analysis: of that image.

    Returns:
        ``[h', w', 3]`` RGB, at most 2048 px a side before the caption is added.
    """
    record = analysis.measurement
    canvas = open_canvas(image, record, analysis.scale)
    _draw_mask(canvas.picture, analysis, canvas.scale)
    _draw_prompt(canvas.picture, analysis, canvas.scale)
    return finish(canvas, analysis, _size(record), f"; mask score {record.mask_score:.2f}{_low_mask(record)}")


def full_mask(analysis: DrawableArea, max_pixels: int) -> NDArray[np.uint8]:
    """Draw the mask in the size of the image: ``[h, w, 3]``, 255 on the object and 0 elsewhere.

    Raises:
        OutputError: the image has more pixels than the limits allow.
    """
    record = analysis.measurement
    width, height = record.image_width_px, record.image_height_px
    if width * height > max_pixels:
        raise OutputError(
            f"cannot write a mask of {width} x {height} px, the limit is {max_pixels} pixels: take the outline "
            "from the record"
        )
    window, mask = analysis.segmentation.window, analysis.segmentation.mask
    full = np.zeros((height, width, 3), np.uint8)
    full[window.y_px : window.y_px + window.height_px, window.x_px : window.x_px + window.width_px][mask] = 255
    return full


def _line_px(picture: NDArray[np.uint8]) -> int:
    return int(np.clip(round(max(picture.shape[:2]) / 500), 1, 3))


def _draw_mask(picture: NDArray[np.uint8], analysis: DrawableArea, scale: NDArray[np.float64]) -> None:
    """Tint the object and draw its outline, both from the mask, because the record's outline is simplified."""
    mask, window = analysis.segmentation.mask, analysis.segmentation.window
    left, top = (round(at * factor) for at, factor in zip((window.x_px, window.y_px), scale, strict=True))
    right = round((window.x_px + window.width_px) * scale[0])
    bottom = round((window.y_px + window.height_px) * scale[1])
    if right <= left or bottom <= top:
        return
    share = cv2.resize(mask.view(np.uint8) * 255, (right - left, bottom - top), interpolation=cv2.INTER_AREA)
    shown = np.asarray(share > 127, dtype=np.uint8)
    region = picture[top:bottom, left:right]
    tint = np.array(MEASURED_RGB, dtype=np.float64)
    region[shown > 0] = np.rint((1 - _TINT) * region[shown > 0] + _TINT * tint).astype(np.uint8)
    rings, _ = cv2.findContours(np.pad(shown, 1), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.polylines(
        picture,
        [ring + np.array([left - 1, top - 1], np.int32) for ring in rings],
        True,
        MEASURED_RGB,
        _line_px(picture),
    )


def _draw_prompt(picture: NDArray[np.uint8], analysis: DrawableArea, scale: NDArray[np.float64]) -> None:
    prompt, line = analysis.prompt, _line_px(picture)
    fine = 1 << _SUBPIXEL_BITS
    if prompt.box is not None:
        # The origin of prompts is the corner of the first pixel, OpenCV's is its centre.
        corners = np.rint((np.reshape(prompt.box, (2, 2)) * scale - 0.5) * fine).astype(int).tolist()
        cv2.rectangle(picture, corners[0], corners[1], PROMPT_RGB, 1, cv2.LINE_AA, _SUBPIXEL_BITS)
    for x, y, include in prompt.points:
        at = np.rint((np.array([x, y]) * scale - 0.5) * fine).astype(int).tolist()
        colour = PROMPT_RGB if include else _OUTSIDE_RGB
        cv2.circle(picture, at, 3 * line * fine, (0, 0, 0), cv2.FILLED, cv2.LINE_AA, _SUBPIXEL_BITS)
        cv2.circle(picture, at, 2 * line * fine, colour, cv2.FILLED, cv2.LINE_AA, _SUBPIXEL_BITS)


def _size(record: AreaMeasurement) -> str:
    if record.area_m2 is None and not record.mask_area_px:
        return "no object found"
    return size_in_words(
        record.area_m2, record.area_ci95_low_m2, record.area_ci95_high_m2, "m2", f"{record.mask_area_px} px"
    )


def _low_mask(record: AreaMeasurement) -> str:
    """Mark a low mask score if the scale itself is usable."""
    scale_is_good = record.confidence is None or record.confidence >= FALLBACK_CONFIDENCE
    return " - low" if record.status == "low_confidence" and scale_is_good else ""
