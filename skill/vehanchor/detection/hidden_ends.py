"""Straight edges at the ends of vehicles, below which a part of a car may be hidden.

A car that is half under a roof, or half in a hard shadow, seems to be a shorter car. The edge shows
it: it is straight, and goes on beyond both sides of the car. Kerbs, walls and rows of other cars do
the same at the ends of whole cars, so that such an edge only makes a length less certain.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import NDArray

    Chips: TypeAlias = NDArray[np.uint8]
    """``[n, rows, columns, 3]`` RGB, vehicles along the columns in the middle."""

    Columns: TypeAlias = NDArray[np.float64]
    """``[n, 2]`` columns of both ends of each vehicle."""

    Strengths: TypeAlias = NDArray[np.float64]
    """``[n]`` strength of the stronger edge of each vehicle."""

    Factors: TypeAlias = NDArray[np.float64]
    """``[n]`` standard deviations of log lengths."""

# Differences of means over three columns on either side.
_ACROSS = np.array([[-1, -1, -1, 0, 1, 1, 1]], np.float32) / 3
# Rows from the middle of a chip at which the ground beside a car is seen.
_BESIDE_ROWS = (10, 26)
# Columns around an end at which its edge is looked for.
_REACH_COLUMNS = 4
# Difference of colours, CIELAB in 0..255, that is no edge even if it is the same in all rows.
_NOISE = 6.0

# Strength at which half of the error counts, and the width of its rise. Of 42 cars cut by a painted
# roof 16 have more, of cars in photographs with one to four vehicles fewer than 5 of 100.
_HALF_STRENGTH = 1.7
_STRENGTH_WIDTH = 0.25
# Standard deviation of the log length behind such an edge. Those 16 seem 19 % too long, with a
# spread of 14 %; a whole car at a kerb errs as others do, and which one is seen is unknown. With
# 0.15 no usable photograph is lost, with 0.2 and a strength of 1.4 5 of 366.
_HIDDEN_LOG_SD = 0.15


def edge_strengths(chips: Chips, ends: Columns) -> Strengths:
    """Measure how clearly a straight edge crosses the ground at the ends of vehicles.

    The strength is the mean difference of colours across the edge, over the spread of that
    difference along the edge. It is at its largest near the end.

    Args:
        chips: ``[n, rows, columns, 3]`` RGB.
        ends: ``[n, 2]`` columns of both ends.
    """
    strengths = np.zeros(len(chips))
    for k, (chip, columns) in enumerate(zip(chips, ends, strict=True)):
        by_column = _edge_by_column(chip)
        strengths[k] = max(_strength_near(by_column, column) for column in columns)
    return strengths


def hidden_log_sds(strengths: Strengths) -> Factors:
    """Compute the further error ``[n]`` of log lengths; it rises smoothly with the strength."""
    excess = (strengths - _HALF_STRENGTH) / _STRENGTH_WIDTH
    return np.asarray(_HIDDEN_LOG_SD / (1.0 + np.exp(-excess)))


def _edge_by_column(chip: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Measure the strength of an edge along each column of a chip ``[columns]``."""
    lab = cv2.cvtColor(np.ascontiguousarray(chip), cv2.COLOR_RGB2LAB).astype(np.float32)
    smooth = cv2.GaussianBlur(lab, (0, 0), 1.0)
    differences = cv2.filter2D(smooth, -1, _ACROSS)
    middle = len(chip) // 2
    near, far = _BESIDE_ROWS
    # Both sides of the car count together: an edge has the same sign on both.
    first_side = differences[middle - far : middle - near]
    second_side = differences[middle + near : middle + far]
    beside = np.concatenate([first_side, second_side])
    contrast = np.linalg.norm(beside.mean(axis=0), axis=-1)
    variation = np.linalg.norm(beside.std(axis=0), axis=-1)
    return np.asarray(contrast / (variation + _NOISE), np.float64)


def _strength_near(by_column: NDArray[np.float64], column: float) -> float:
    """Find the largest strength near a column; 0 outside the chip."""
    first = max(0, round(column) - _REACH_COLUMNS)
    last = round(column) + _REACH_COLUMNS + 1
    near = by_column[first:last]
    return float(near.max(initial=0.0))
