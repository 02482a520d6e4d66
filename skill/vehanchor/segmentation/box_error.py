"""Error of a mask's area from the error of the box that names it.

Nobody, and no model, draws a box better than by some 2 px of the copy in view. For an object of 40
px that moves the mask by 10 to 30 % of its area, while the predicted IoU stays the same.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from vehanchor.segmentation.prompt import MIN_BOX_PX

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.imagery.raster import Window
    from vehanchor.segmentation.prompt import Box

BOX_ERROR_PX = 2.0
"""Error of each side of a box, pixels of the copy in which it was drawn."""

SMALL_MASK_PX = 2000
"""Masks with fewer pixels of that copy are drawn with other boxes, too. Larger ones hardly follow
the box: between 2,000 and 3,000 px the spread is 0.04, median of 32, which is less than half of a
mask's own error (``research/results/notes.md``)."""

MAX_BOX_LOG_SD = math.log(1.44) / 1.96
"""Largest standard deviation of the log of the area: its 95 % interval is then as wide as that of
a scale that is right within 20 %, which is what status ok promises."""


def resized_boxes(box: Box, window: Window, error_px: float) -> list[Box]:
    """Shrink and grow a box by its error on each side, inside its window.

    Args:
        box: x1, y1, x2, y2, pixels of the image.
        window: the crop around it.
        error_px: error of a side, pixels of the image.
    """
    x1, y1, x2, y2 = box
    shorter_side = min(x2 - x1, y2 - y1)
    # A shrunk box stays large enough to be a prompt.
    inwards = max(0.0, min(error_px, (shorter_side - MIN_BOX_PX) / 2))
    shrunk = (x1 + inwards, y1 + inwards, x2 - inwards, y2 - inwards)
    right = window.x_px + window.width_px
    bottom = window.y_px + window.height_px
    grown = (
        max(window.x_px, x1 - error_px),
        max(window.y_px, y1 - error_px),
        min(right, x2 + error_px),
        min(bottom, y2 + error_px),
    )
    return [shrunk, grown]


def box_log_sd(areas_px: Sequence[int]) -> float:
    """Compute the standard deviation of the log of the areas of masks of equally probable boxes.

    The three boxes are all that there is to the distribution, not a sample of it: on objects of
    known area it then holds what its interval promises (``research/results/notes.md``).

    An empty mask counts as one pixel.
    """
    log_areas = np.log(np.maximum(areas_px, 1))
    return float(np.std(log_areas))
