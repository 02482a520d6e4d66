"""Marks of rulers other than vehicles: lines and outlines, labelled in metres; a cross for a height."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.pictures.lettering import text_px, text_width, write_on
from vehanchor.pictures.placement import line_px

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor.pictures.placement import Placement
    from vehanchor.scale.posterior import Mark

MARK_RGB = (0, 190, 138)  # Okabe and Ito's bluish green, lighter
_RIM_RGB = (22, 24, 28)
_LETTERS = 0.8  # height of capitals over that of the caption


def draw_marks(
    picture: NDArray[np.uint8],
    marks: Sequence[Mark],
    place: Placement,
    colour: tuple[int, int, int] = MARK_RGB,
) -> None:
    """Draw the marks of rulers that lie in the picture, with labels beside their middle.

    Args:
        picture: ``[h, w, 3]`` RGB, drawn into.
        marks: in pixels of the image.
        place: of the image in the picture.
        colour: RGB colour of the lines.
    """
    line = line_px(picture)
    labels = []
    for mark in marks:
        # The origin of marks is the corner of the first pixel, OpenCV's is its centre.
        points = place.at(mark.points) - 0.5
        if (points.max(axis=0) < 0).any() or (points.min(axis=0) > picture.shape[1::-1]).any():
            continue  # outside a cut
        strokes = (
            _cross(points[0], line)
            if len(points) == 1
            else []
            if mark.closed
            else _ends(points, line)
        )
        for at, closed in ((points, mark.closed), *((stroke, False) for stroke in strokes)):
            for ink, thickness in ((_RIM_RGB, line + 2), (colour, line)):
                cv2.polylines(
                    picture, [np.rint(at).astype(np.int32)], closed, ink, thickness, cv2.LINE_AA
                )
        if mark.label:
            labels.append((mark.label, points[:2].mean(axis=0) if mark.closed else _middle(points)))
    for label, middle in labels:
        _write_label(picture, label, middle)


def _middle(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute the midpoint along an open line."""
    legs = np.hypot(*np.diff(points, axis=0).T) if len(points) > 1 else np.zeros(0)
    way = np.concatenate([[0.0], np.cumsum(legs)])
    return np.array([np.interp(way[-1] / 2, way, points[:, axis]) for axis in (0, 1)])


def _ends(points: NDArray[np.float64], line: int) -> list[NDArray[np.float64]]:
    """Make short strokes across the ends, as in a dimensioned drawing."""
    strokes = []
    for end, along in ((points[0], points[1] - points[0]), (points[-1], points[-1] - points[-2])):
        across = (
            np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-9) * (3.0 + 2 * line)
        )
        strokes.append(np.array([end - across, end + across]))
    return strokes


def _cross(middle: NDArray[np.float64], line: int) -> list[NDArray[np.float64]]:
    """Make the arms of a cross, for a ruler without a line."""
    reach = 6.0 + 3 * line
    return [np.array([middle - arm, middle + arm]) for arm in np.diag([reach, reach])]


def _write_label(picture: NDArray[np.uint8], label: str, middle: NDArray[np.float64]) -> None:
    """Write a label right of and above a line's middle, shifted into the picture."""
    height, width = picture.shape[:2]
    capital = max(9, round(_LETTERS * text_px(width)))
    left = int(np.clip(middle[0] + capital // 2, 2, max(2, width - text_width(label, capital) - 4)))
    baseline = int(np.clip(middle[1] - capital // 2, capital + 4, max(capital + 4, height - 4)))
    write_on(picture, label, at=(left, baseline), capital_px=capital)
