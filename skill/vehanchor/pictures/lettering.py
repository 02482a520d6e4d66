"""Text in pictures: sizes, and letters that are legible on any background."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

FONT = cv2.FONT_HERSHEY_SIMPLEX


def text_px(picture_width_px: int) -> int:
    """Compute the height of capitals for a picture's width."""
    return int(np.clip(picture_width_px / 58, 11, 28))


def font_scale(capital_px: float) -> float:
    """Compute OpenCV's font scale for a height of capitals."""
    return capital_px / float(cv2.getTextSize("M", FONT, 1.0, 1)[0][1])


def stroke_px(capital_px: float) -> int:
    """Compute the stroke width for a height of capitals."""
    return max(1, round(capital_px / 10))


def text_width(text: str, capital_px: float) -> int:
    """Compute the width of a text, pixels."""
    return int(cv2.getTextSize(text, FONT, font_scale(capital_px), stroke_px(capital_px))[0][0])


def write_on(picture: NDArray[np.uint8], text: str, at: tuple[int, int], capital_px: int) -> None:
    """Write white letters with a black rim.

    Args:
        picture: ``[h, w, 3]`` RGB, drawn into.
        text: one line.
        at: left end of the baseline, pixels.
        capital_px: height of capitals.
    """
    rim = max(2, capital_px // 7)
    left, baseline = at
    top = max(0, baseline - 2 * capital_px)
    first = max(0, left - 2 * rim)
    right = left + text_width(text, capital_px) + 3 * rim
    region = picture[top : max(top, baseline + capital_px), first : max(first, right)]
    if not region.size:
        return
    letters = np.zeros(region.shape[:2], np.uint8)
    stroke = stroke_px(capital_px) + 1
    cv2.putText(
        letters,
        text,
        (left - first, baseline - top),
        FONT,
        font_scale(capital_px),
        255,
        stroke,
        cv2.LINE_AA,
    )
    # In OpenCV 5 a wider stroke makes bolder letters, not a rim.
    around = cv2.dilate(
        letters, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * rim + 1, 2 * rim + 1))
    )
    for mask, level in ((around, 0.0), (letters, 255.0)):
        cover = mask[:, :, None] / 255.0
        region[:] = np.rint(region * (1.0 - cover) + level * cover).astype(np.uint8)
