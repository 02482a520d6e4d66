"""Chips: a candidate with its surroundings, turned along its axis, at one length."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

CHIP_PX = 48  # rows and columns
CHIP_LENGTH_PX = 20.0  # the candidate's own length on its chip, along the columns: 0.7 lengths of surroundings each way


def chip(
    image: NDArray[np.uint8], box: NDArray[np.float64], side_px: int = CHIP_PX, length_px: float = CHIP_LENGTH_PX
) -> NDArray[np.uint8]:
    """Cut one candidate.

    The image is reduced by averaging to at most 1.5 times the chip's resolution, then sampled linearly; what lies
    outside repeats the border.

    Args:
        image: ``[h, w, 3]`` uint8 RGB.
        box: ``(x, y, length, width, angle)`` in pixels and radians; the width is not used.
        side_px: rows and columns of the chip.
        length_px: the candidate's length on the chip.

    Returns:
        ``[side, side, 3]`` uint8; the box's middle is the chip's, its axis runs along the columns.
    """
    x, y, length, _, angle = box
    step = length / length_px  # image pixels to one of the chip
    reach = 0.75 * side_px * step + 2  # beyond the corners of the turned chip
    height, width = image.shape[:2]
    left, right = int(np.clip(x - reach, 0, width - 1)), int(np.clip(x + reach + 1, 1, width))
    top, bottom = int(np.clip(y - reach, 0, height - 1)), int(np.clip(y + reach + 1, 1, height))
    part = image[top : max(bottom, top + 1), left : max(right, left + 1)]
    new_width = max(1, round(part.shape[1] * min(1.0, 1.5 / step)))
    new_height = max(1, round(part.shape[0] * min(1.0, 1.5 / step)))
    if (new_height, new_width) != part.shape[:2]:
        ratio = np.array([new_width / part.shape[1], new_height / part.shape[0]])
        part = np.asarray(cv2.resize(part, (new_width, new_height), interpolation=cv2.INTER_AREA), np.uint8)
    else:
        ratio = np.ones(2)
    turn = step * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])  # chip -> image
    origin = np.array([x - left, y - top]) - turn @ [side_px / 2, side_px / 2]
    matrix = np.column_stack([turn * ratio[:, None], origin * ratio])
    matrix[:, 2] += matrix[:, :2] @ (0.5, 0.5) - 0.5  # continuous coordinates have pixel centres at +0.5
    cut = cv2.warpAffine(
        part,
        matrix,
        (side_px, side_px),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(cut, np.uint8)
