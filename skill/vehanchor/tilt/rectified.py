"""Vehicles rectified to a camera at nadir.

In a tilted view nearer cars are longer than farther ones, and cars that point away are foreshortened. A detector
trained on nadir images still draws boxes with a car's proportions. On the ground plane a car that points away is
therefore too long and too narrow; a car across the view is too short and too wide. Three quarters of the log length
plus one quarter of the log width do not depend on the car's direction.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from vehanchor.detection.detections import Detections
    from vehanchor.scale.plane import GroundPlane

_BY_WIDTH = 0.25  # share of the width in the log of a length: 0.2 to 0.3 do alike at 30 and 45 degrees, train split
_LENGTH_OVER_WIDTH = 2.21  # of the detector's boxes at nadir


def rectified(detections: Detections, plane: GroundPlane) -> Detections:
    """Rectify the lengths and widths of vehicles to nadir and to the scale of the image's centre.

    Args:
        detections: in pixels of the image; positions and angles are kept.
        plane: ground plane; its scale does not matter.
    """
    plane = replace(plane, gsd_m_per_px=1.0)
    boxes = detections.boxes
    along = np.column_stack([np.cos(boxes[:, 4]), np.sin(boxes[:, 4])])
    across = np.column_stack([-along[:, 1], along[:, 0]])
    sides = []
    for column, direction in ((2, along), (3, across)):
        reach = direction * boxes[:, column : column + 1] / 2
        sides.append(plane.length(boxes[:, :2] - reach, boxes[:, :2] + reach))
    measured = boxes.copy()
    measured[:, 2] = sides[0] ** (1 - _BY_WIDTH) * (_LENGTH_OVER_WIDTH * sides[1]) ** _BY_WIDTH
    measured[:, 3] = measured[:, 2] / _LENGTH_OVER_WIDTH
    return replace(detections, boxes=measured)
