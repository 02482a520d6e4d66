"""Sample of candidates by position, for tiles with hundreds of them: a car park from edge to edge."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vehanchor.detection.scheduler import PLASTIC

if TYPE_CHECKING:
    from numpy.typing import NDArray

_CELL_LENGTHS = 3.0  # side of a cell in median lengths: nearly all boxes of one vehicle are in one cell


def position_sample(boxes: NDArray[np.float64], least: int) -> NDArray[np.intp]:
    """Choose the candidates of some small cells, which spread evenly over a tile.

    The choice depends on the positions alone, so that it favours no score and no size. Boxes of one vehicle stay
    together, so that non-maximum suppression sees them all.

    Args:
        boxes: ``[n, 5]`` rows ``(x, y, length, width, angle)`` in pixels of the tile.
        least: cells are added until they hold so many candidates.

    Returns:
        Their indices in ascending order; all of them if there are no more than ``least``.
    """
    if len(boxes) <= least:
        return np.arange(len(boxes))
    cells = np.floor(boxes[:, :2] / (_CELL_LENGTHS * np.median(boxes[:, 2])))
    rank = (cells @ np.array(PLASTIC)) % 1.0
    return np.flatnonzero(rank <= np.partition(rank, least - 1)[least - 1])
