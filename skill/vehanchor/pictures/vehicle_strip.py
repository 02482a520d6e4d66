"""Strip of enlarged vehicles with their numbers, to check whether they are cars."""

from __future__ import annotations

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

MOST_SHOWN = 24
_CHIP_PX = 128
_REACH = 1.0  # half of a chip's side over the vehicle's length
_LEAST_REACH_PX = 8
_CAPITAL_PX = 14


def draw_vehicle_strip(raster: Raster, analysis: ScaleEvidence, width_px: int) -> NDArray[np.uint8]:
    """Draw the first vehicles by their numbers, each enlarged with its box, in rows.

    Args:
        raster: the analysed image.
        analysis: of that image.
        width_px: width of the strip.

    Returns:
        ``[h, width_px, 3]`` RGB; no rows without vehicles.
    """
    boxes = analysis.detections.boxes[:MOST_SHOWN]
    columns = max(1, width_px // _CHIP_PX)
    strip = np.zeros((-(-len(boxes) // columns) * _CHIP_PX, max(width_px, _CHIP_PX), 3), np.uint8)
    for i, (box, number, kept) in enumerate(
        zip(boxes, analysis.detections.numbers, analysis.kept, strict=False)
    ):
        top = i // columns * _CHIP_PX
        left = i % columns * _CHIP_PX
        chip = _draw_vehicle(raster, box, KEPT_RGB if kept else DROPPED_RGB)
        write_on(chip, str(number), at=(4, _CAPITAL_PX + 4), capital_px=_CAPITAL_PX)
        strip[top : top + chip.shape[0], left : left + chip.shape[1]] = chip
    return strip[:, :width_px]


def _draw_vehicle(
    raster: Raster, box: NDArray[np.float64], colour: tuple[int, int, int]
) -> NDArray[np.uint8]:
    reach = max(_LEAST_REACH_PX, round(_REACH * float(box[2])))
    x = round(float(box[0]))
    y = round(float(box[1]))
    left = max(0, x - reach)
    top = max(0, y - reach)
    part = Window(
        left,
        top,
        width_px=min(raster.width_px, x + reach) - left,
        height_px=min(raster.height_px, y + reach) - top,
    )
    chip = Cut(part, _CHIP_PX).sized(raster.read(part))
    corners = Placement.of(chip, part).pixels(box_corners(box[None]))
    cv2.polylines(chip, list(corners), True, colour, 1, cv2.LINE_AA)
    return chip
