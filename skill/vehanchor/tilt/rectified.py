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

from vehanchor.detection.boxes import box_axes
from vehanchor.scale.defaults import CAR_LENGTH_OVER_WIDTH

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.detection.detections import Detections
    from vehanchor.scale.plane import GroundPlane

_BODY_LENGTH_OVER_WIDTH = 2.6  # at nadir; medians of seven places go from 2.47 to 2.65
_BY_WIDTH = 0.25  # share of the width in the log of a length: 0.2 to 0.3 do alike at 30 and 45 degrees, train split


def rectified(detections: Detections, plane: GroundPlane) -> Detections:
    """Rectify the lengths and widths of vehicles to nadir and to the scale of the image's centre.

    Args:
        detections: in pixels of the image; positions and angles are kept.
        plane: ground plane; its scale does not matter.
    """
    plane = replace(plane, gsd_m_per_px=1.0)
    lengths, widths = (plane.length(*ends) for ends in box_axes(detections.boxes))
    measured = detections.boxes.copy()
    measured[:, 2] = length_off_nadir(lengths, widths, bodies=detections.looks is not None)
    measured[:, 3] = measured[:, 2] / CAR_LENGTH_OVER_WIDTH
    return replace(detections, boxes=measured)


def length_off_nadir(lengths: NDArray[np.float64], widths: NDArray[np.float64], *, bodies: bool) -> NDArray[np.float64]:
    """Combine lengths and widths ``[n]`` on the ground to lengths that do not depend on the car's direction.

    Args:
        lengths: of boxes.
        widths: of boxes.
        bodies: whether these are the boxes of bodies, as the chip network measures them.
    """
    proportion = _BODY_LENGTH_OVER_WIDTH if bodies else CAR_LENGTH_OVER_WIDTH
    return np.asarray(lengths ** (1 - _BY_WIDTH) * (proportion * widths) ** _BY_WIDTH)
