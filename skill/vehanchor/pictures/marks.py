"""Marks of rulers other than vehicles: lines and outlines with labels in metres, and crosses."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.pictures.lettering import text_px, text_width, write_on
from vehanchor.pictures.placement import line_px

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.pictures.placement import Colour, Placement, Points, RgbImage
    from vehanchor.scale.posterior import Mark

# A lighter version of the bluish green of Okabe and Ito.
MARK_RGB = (0, 190, 138)
_RIM_RGB = (22, 24, 28)
# Height of a label's capitals over that of the caption's.
_LABEL_SHARE = 0.8


def draw_marks(
    picture: RgbImage,
    marks: Sequence[Mark],
    placement: Placement,
    *,
    colour: Colour = MARK_RGB,
) -> None:
    """Draw the marks of rulers that lie in the picture, with labels beside their middle.

    Args:
        picture: ``[h, w, 3]`` RGB, drawn into.
        marks: marks in pixels of the image.
        placement: position of the image in the picture.
        colour: RGB colour of the lines.
    """
    line = line_px(picture)
    labels = []
    for mark in marks:
        # The origin of marks is the corner of the first pixel, OpenCV's is its centre.
        points = placement.to_picture(mark.points) - 0.5
        if _is_outside(points, picture):
            continue
        _draw_stroke(picture, points, closed=mark.closed, colour=colour, line=line)
        for stroke in _end_strokes(mark, points, line):
            _draw_stroke(picture, stroke, closed=False, colour=colour, line=line)
        if mark.label:
            if mark.closed:
                middle = points[:2].mean(axis=0)
            else:
                middle = _middle(points)
            labels.append((mark.label, middle))
    # Labels last, so that no mark covers them.
    for label, middle in labels:
        _write_label(picture, label, middle)


def _is_outside(points: Points, picture: RgbImage) -> bool:
    """Test whether all points lie beyond one side of a picture, which may be a cut."""
    height, width = picture.shape[:2]
    before = points.max(axis=0) < 0
    after = points.min(axis=0) > (width, height)
    return bool(before.any() or after.any())


def _draw_stroke(
    picture: RgbImage,
    points: Points,
    *,
    closed: bool,
    colour: Colour,
    line: int,
) -> None:
    """Draw a line of a colour on a wider dark one, which shows on any background."""
    corners = [np.rint(points).astype(np.int32)]
    for ink, thickness in ((_RIM_RGB, line + 2), (colour, line)):
        cv2.polylines(
            picture,
            corners,
            isClosed=closed,
            color=ink,
            thickness=thickness,
            lineType=cv2.LINE_AA,
        )


def _middle(points: Points) -> Points:
    """Compute the midpoint along an open line; a single point is its own midpoint."""
    if len(points) == 1:
        middle: Points = points[0]
        return middle
    legs = np.diff(points, axis=0)
    lengths = np.hypot(*legs.T)
    way = np.concatenate([[0.0], np.cumsum(lengths)])
    half_way = way[-1] / 2
    xs, ys = points.T
    x = np.interp(half_way, way, xs)
    y = np.interp(half_way, way, ys)
    return np.array([x, y])


def _end_strokes(mark: Mark, points: Points, line: int) -> list[Points]:
    """Make the strokes that complete a mark: a cross for a place, short strokes at line ends."""
    if len(points) == 1:
        return _cross(points[0], line)
    if mark.closed:
        return []
    # As in a dimensioned drawing.
    length = 3.0 + 2 * line
    first = _stroke_across(points[0], points[1] - points[0], length)
    last = _stroke_across(points[-1], points[-1] - points[-2], length)
    return [first, last]


def _stroke_across(end: Points, along: Points, length: float) -> Points:
    """Make a stroke that crosses a direction at a right angle, ``length`` to both sides."""
    perpendicular = np.array([-along[1], along[0]])
    # A direction of length 0, from two equal points, has no stroke.
    distance = max(float(np.hypot(*along)), 1e-9)
    across = perpendicular / distance * length
    return np.array([end - across, end + across])


def _cross(middle: Points, line: int) -> list[Points]:
    """Make the arms of a cross, for a ruler without a line."""
    reach = 6.0 + 3 * line
    across = np.array([reach, 0.0])
    down = np.array([0.0, reach])
    horizontal = np.array([middle - across, middle + across])
    vertical = np.array([middle - down, middle + down])
    return [horizontal, vertical]


def _write_label(picture: RgbImage, label: str, middle: Points) -> None:
    """Write a label right of and above a line's middle, shifted into the picture."""
    height, width = picture.shape[:2]
    capital = max(9, round(_LABEL_SHARE * text_px(width)))
    label_width = text_width(label, capital)
    max_left = max(2, width - label_width - 4)
    min_baseline = capital + 4
    max_baseline = max(min_baseline, height - 4)
    x, y = middle
    left = int(np.clip(x + capital // 2, 2, max_left))
    baseline = int(np.clip(y - capital // 2, min_baseline, max_baseline))
    write_on(picture, label, (left, baseline), capital_px=capital)
