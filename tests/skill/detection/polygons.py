"""The plain oracle for what oriented boxes share."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from vehanchor.detection.boxes import box_corners

NEARBY_BOX = st.tuples(
    st.floats(-60, 60), st.floats(-60, 60), st.floats(4, 60), st.floats(2, 40), st.floats(-7, 7)
)  # near one another, so that many overlap


def _clip(subject: NDArray[np.float64], clip: NDArray[np.float64]) -> NDArray[np.float64]:
    """What two convex polygons share (Sutherland and Hodgman)."""
    output = list(subject)
    for a, b in zip(clip, np.roll(clip, -1, axis=0), strict=True):
        points, output = output, []
        for p, q in zip(points, points[1:] + points[:1], strict=True):
            side_p = (b[0] - a[0]) * (p[1] - a[1]) - (b[1] - a[1]) * (p[0] - a[0])
            side_q = (b[0] - a[0]) * (q[1] - a[1]) - (b[1] - a[1]) * (q[0] - a[0])
            if side_p >= 0:
                output.append(p)
            if (side_p >= 0) != (side_q >= 0):
                output.append(p + (q - p) * side_p / (side_p - side_q))
        if not output:
            break
    return np.array(output).reshape(-1, 2)


def _area(polygon: NDArray[np.float64]) -> float:
    x, y = polygon[:, 0], polygon[:, 1]
    return 0.5 * abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1)))


def polygon_iou(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    """IoU of two canonical boxes, from their corners."""
    corners = box_corners(np.stack([a, b]))
    shared = _area(_clip(corners[0], corners[1]))
    return float(shared / (a[2] * a[3] + b[2] * b[3] - shared))
