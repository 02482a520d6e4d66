"""Strip of enlarged vehicles with their numbers, to check whether they are cars."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.detection.boxes import box_corners
from vehanchor.imagery.raster import Window
from vehanchor.pictures.lettering import write_on
from vehanchor.pictures.placement import Cut, Placement
from vehanchor.pictures.scale import DROPPED_RGB, KEPT_RGB

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster
    from vehanchor.pictures.evidence import ScaleEvidence
    from vehanchor.pictures.placement import Colour, RgbImage

MAX_SHOWN = 24
_CHIP_PX = 128
# Half of a chip's side over the vehicle's length.
_REACH_SHARE = 1.0
_MIN_REACH_PX = 8
_CAPITAL_PX = 14


def draw_vehicle_strip(
    raster: Raster, analysis: ScaleEvidence, width_px: int, *, within: Window | None = None
) -> RgbImage:
    """Draw the first vehicles by their numbers, each enlarged with its box, in rows.

    Args:
        raster: the analysed image.
        analysis: analysis of that image.
        width_px: width of the strip.
        within: part of the image whose vehicles to draw; None for all of the image.

    Returns:
        ``[h, width_px, 3]`` RGB; no rows without vehicles.
    """
    detections = analysis.detections
    shown = np.flatnonzero(_lie_within(detections.boxes, within))[:MAX_SHOWN]
    boxes = detections.boxes[shown]
    n_columns = max(1, width_px // _CHIP_PX)
    n_rows = math.ceil(len(boxes) / n_columns)
    strip = np.zeros((n_rows * _CHIP_PX, max(width_px, _CHIP_PX), 3), np.uint8)
    vehicles = zip(boxes, detections.numbers[shown], analysis.kept[shown], strict=True)
    for i, (box, number, is_kept) in enumerate(vehicles):
        row, column = divmod(i, n_columns)
        top = row * _CHIP_PX
        left = column * _CHIP_PX
        chip = _draw_vehicle(raster, box, KEPT_RGB if is_kept else DROPPED_RGB)
        write_on(chip, str(number), (4, _CAPITAL_PX + 4), capital_px=_CAPITAL_PX)
        # At the image's edge, a chip is smaller than its cell.
        height, width = chip.shape[:2]
        strip[top : top + height, left : left + width] = chip
    return strip[:, :width_px]


def _lie_within(boxes: NDArray[np.float64], part: Window | None) -> NDArray[np.bool_]:
    """Test which boxes have their centre in a part of the image; all without a part."""
    if part is None:
        return np.ones(len(boxes), dtype=bool)
    first = (part.x_px, part.y_px)
    last = (part.x_px + part.width_px, part.y_px + part.height_px)
    centres = boxes[:, :2]
    is_inside = (centres >= first) & (centres < last)
    return np.asarray(is_inside.all(axis=1), dtype=bool)


def _draw_vehicle(raster: Raster, box: NDArray[np.float64], colour: Colour) -> RgbImage:
    centre_x, centre_y, length, _, _ = box.tolist()
    x = round(centre_x)
    y = round(centre_y)
    reach = max(_MIN_REACH_PX, round(_REACH_SHARE * length))
    left = max(0, x - reach)
    top = max(0, y - reach)
    right = min(raster.width_px, x + reach)
    bottom = min(raster.height_px, y + reach)
    part = Window(left, top, width_px=right - left, height_px=bottom - top)
    chip = Cut(part, _CHIP_PX).sized(raster.read(part))
    placement = Placement.of(chip, part)
    corners = placement.to_opencv(box_corners(box[None]))
    cv2.polylines(
        chip,
        list(corners),
        isClosed=True,
        color=colour,
        thickness=1,
        lineType=cv2.LINE_AA,
    )
    return chip
