"""Text in pictures: sizes, and letters that are legible on any background."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

FONT = cv2.FONT_HERSHEY_SIMPLEX


# Widths of the picture over the height of its capitals, and the limits of that height, pixels.
_WIDTH_PER_CAPITAL = 58
_CAPITAL_RANGE_PX = (11, 28)


def text_px(picture_width_px: int) -> int:
    """Compute the height of capitals for a picture's width."""
    return int(np.clip(picture_width_px / _WIDTH_PER_CAPITAL, *_CAPITAL_RANGE_PX))


def font_scale(capital_px: float) -> float:
    """Compute OpenCV's font scale for a height of capitals."""
    (_, height_px), _ = cv2.getTextSize("M", FONT, 1.0, 1)
    return capital_px / float(height_px)


def stroke_px(capital_px: float) -> int:
    """Compute the stroke width for a height of capitals."""
    return max(1, round(capital_px / 10))


def text_width(text: str, capital_px: float, stroke: int | None = None) -> int:
    """Compute the width of a text, pixels.

    Args:
        text: the text.
        capital_px: height of its capitals.
        stroke: width of its strokes, pixels, with which letters become broader; None for the usual
            one.
    """
    scale = font_scale(capital_px)
    thickness = stroke or stroke_px(capital_px)
    (width_px, _), _ = cv2.getTextSize(text, FONT, scale, thickness)
    return int(width_px)


def put_text(
    picture: NDArray[np.uint8],
    text: str,
    start: tuple[int, int],
    *,
    capital_px: float,
    colour: Sequence[int] | int,
    stroke: int,
) -> None:
    """Write plain letters.

    Args:
        picture: ``[h, w]`` or ``[h, w, 3]``, drawn into.
        text: one line.
        start: left end of the baseline, pixels.
        capital_px: height of capitals.
        colour: value of the letters: one number, or RGB.
        stroke: width of the strokes, pixels.
    """
    cv2.putText(
        picture,
        text,
        start,
        fontFace=FONT,
        fontScale=font_scale(capital_px),
        color=colour,
        thickness=stroke,
        lineType=cv2.LINE_AA,
    )


def write_on(
    picture: NDArray[np.uint8], text: str, start: tuple[int, int], *, capital_px: int
) -> None:
    """Write white letters with a black rim.

    Args:
        picture: ``[h, w, 3]`` RGB, drawn into.
        text: one line.
        start: left end of the baseline, pixels.
        capital_px: height of capitals.
    """
    left, baseline = start
    rim = max(2, capital_px // 7)
    # Only the region of the letters and their rim is blended.
    region_top = max(0, baseline - 2 * capital_px)
    region_bottom = max(region_top, baseline + capital_px)
    region_left = max(0, left - 2 * rim)
    right = left + text_width(text, capital_px) + 3 * rim
    region_right = max(region_left, right)
    region = picture[region_top:region_bottom, region_left:region_right]
    if not region.size:
        return
    letters = np.zeros(region.shape[:2], np.uint8)
    put_text(
        letters,
        text,
        (left - region_left, baseline - region_top),
        capital_px=capital_px,
        colour=255,
        stroke=stroke_px(capital_px) + 1,
    )
    # In OpenCV 5 a wider stroke makes bolder letters, not a rim.
    brush_px = 2 * rim + 1
    brush = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (brush_px, brush_px))
    rim_mask = np.asarray(cv2.dilate(letters, brush), dtype=np.uint8)
    _blend(region, rim_mask, 0.0)
    _blend(region, letters, 255.0)


def _blend(region: NDArray[np.uint8], mask: NDArray[np.uint8], level: float) -> None:
    """Blend a grey level into a region ``[h, w, 3]``; the mask ``[h, w]`` is its opacity."""
    opacity = mask[:, :, None] / 255.0
    blended = region * (1.0 - opacity) + level * opacity
    region[:] = np.rint(blended).astype(np.uint8)
