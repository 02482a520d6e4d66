"""What rulers beside vehicles were laid along: lines and outlines with their metres; a height stands in the middle."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.pictures.lettering import text_px, text_width, write_on

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.anchors.evidence import Mark

__all__ = ["MARK_RGB", "draw_marks"]

MARK_RGB = (0, 190, 138)  # Okabe and Ito's bluish green, lighter
_RIM_RGB = (22, 24, 28)
_SUBPIXEL_BITS = 4
_LETTERS = 0.8  # of the height of the caption's


def draw_marks(picture: NDArray[np.uint8], marks: Sequence[Mark], scale: NDArray[np.float64]) -> None:
    """Draw the lines that rulers were laid along, with their labels beside the middle.

    Args:
        picture: ``[h, w, 3]`` RGB, drawn into.
        marks: in pixels of the image.
        scale: ``[2]`` pixels of the picture per image pixel, across and down.
    """
    line = int(np.clip(round(max(picture.shape[:2]) / 500), 1, 3))
    labels = []
    for mark in marks:
        # Marks count from the corner of the first pixel, OpenCV from its centre.
        points = np.asarray(mark.points, dtype=np.float64) * scale - 0.5
        fixed_point = np.rint(points * (1 << _SUBPIXEL_BITS)).astype(np.int32)
        for colour, thickness in ((_RIM_RGB, line + 2), (MARK_RGB, line)):
            cv2.polylines(picture, [fixed_point], mark.closed, colour, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)
        if not mark.closed and len(points) == 2:
            _draw_ends(picture, points, line)
        elif len(points) == 1:
            _draw_cross(picture, points[0], line)
        if mark.label:
            labels.append((mark.label, points[:2].mean(axis=0)))
    for label, middle in labels:
        _write_label(picture, label, middle)


def _draw_ends(picture: NDArray[np.uint8], points: NDArray[np.float64], line: int) -> None:
    """Short strokes across the ends, as on a drawing with dimensions."""
    along = points[1] - points[0]
    across = np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-9) * (3.0 + 2 * line)
    for end in points:
        stroke = np.rint(np.array([end - across, end + across]) * (1 << _SUBPIXEL_BITS)).astype(np.int32)
        for colour, thickness in ((_RIM_RGB, line + 2), (MARK_RGB, line)):
            cv2.polylines(picture, [stroke], False, colour, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)


def _draw_cross(picture: NDArray[np.uint8], middle: NDArray[np.float64], line: int) -> None:
    """A cross where a ruler holds that was laid along nothing."""
    reach = 6.0 + 3 * line
    for colour, thickness in ((_RIM_RGB, line + 2), (MARK_RGB, line)):
        for arm in ((reach, 0.0), (0.0, reach)):
            stroke = np.rint(np.array([middle - arm, middle + arm]) * (1 << _SUBPIXEL_BITS)).astype(np.int32)
            cv2.polylines(picture, [stroke], False, colour, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)


def _write_label(picture: NDArray[np.uint8], label: str, middle: NDArray[np.float64]) -> None:
    """Right of and above the middle of a line, moved inside the picture."""
    height, width = picture.shape[:2]
    capital = max(9, round(_LETTERS * text_px(width)))
    left = int(np.clip(middle[0] + capital // 2, 2, max(2, width - text_width(label, capital) - 4)))
    baseline = int(np.clip(middle[1] - capital // 2, capital + 4, max(capital + 4, height - 4)))
    write_on(picture, label, (left, baseline), capital)
