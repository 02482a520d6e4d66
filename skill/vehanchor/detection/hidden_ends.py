"""Straight edges at the ends of vehicles, below which a part of a car may be hidden.

A car that is half under a roof seems to be a shorter car. The edge shows it: it is straight, and
goes on beyond both sides of the car. Kerbs, walls and rows of other cars do the same at the ends of
whole cars, and short cars have the proportions of cut ones, so that both together give a chance.
Hard shadows cut hardly any car: the networks see its other half.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from vehanchor.odds import chances_of, log_odds_of
from vehanchor.scale.reliability import SD_PER_MEDIAN_DEVIATION

if TYPE_CHECKING:
    from typing import TypeAlias

    from numpy.typing import NDArray

    Chips: TypeAlias = NDArray[np.uint8]
    """``[n, rows, columns, 3]`` RGB, vehicles along the columns in the middle."""

    Columns: TypeAlias = NDArray[np.float64]
    """``[n, 2]`` columns of both ends of each vehicle."""

    Strengths: TypeAlias = NDArray[np.float64]
    """``[n]`` strength of the stronger edge of each vehicle."""

    Proportions: TypeAlias = NDArray[np.float64]
    """``[n]`` length over width."""

    Chances: TypeAlias = NDArray[np.float64]
    """``[n]`` chances, 0..1, of a cut vehicle."""

    Errors: TypeAlias = NDArray[np.float64]
    """``[n]`` errors of log lengths."""

# Differences of means over three columns on either side.
_ACROSS = np.array([[-1, -1, -1, 0, 1, 1, 1]], np.float32) / 3
# Rows from the middle of a chip at which the ground beside a car is seen.
_BESIDE_ROWS = (10, 26)
# Columns around an end at which its edge is looked for.
_REACH_COLUMNS = 4
# Difference of colours, CIELAB in 0..255, that is no edge even if it is the same in all rows.
_NOISE = 6.0

# Logistic model of a cut car, by the strength of its edge and the log of its length over its width.
# Fitted to 1,651 cars and to the 374 of 1,452 copies half below a painted roof that the network
# still takes for cars, at 13 places. At the odds that 2 of 100 whole cars have, half of the cut
# ones are found, by the edge alone 14 of 100, by the proportions alone 44; with each place left
# out. Length and width by appearance, compared with the body, tell nothing more: the network
# measures both sides of a cut car too short, and by width it is 7 % too long as well.
_LOG_ODDS = 22.5
_LOG_ODDS_PER_STRENGTH = 0.66
_LOG_ODDS_PER_LOG_PROPORTION = -27.7
_FITTED_SHARE = 374 / 2025
# Share of cars that are cut. A choice.
_CUT_SHARE = 0.02
# Mean and standard deviation of the error of a cut car's log length by its appearance. Those 374
# seem 8 % too long with a spread of 11 %, and 15 % from a third of the length on. Of 13,284 cars in
# photographs of known scale, most of them whole, 284 have a chance above 0.1 and seem 2 % too long.
_HIDDEN_LOG_MEAN = 0.1
_HIDDEN_LOG_SD = 0.12
# Strength at which half of a further error of the log length counts, the width of its rise, and its
# standard deviation, whatever the proportions: roofs also cut long cars. One in ten cars has more.
# A choice.
_HALF_STRENGTH = 2.2
_STRENGTH_WIDTH = 0.25
_EDGE_LOG_SD = 0.15


def edge_strengths(chips: Chips, ends: Columns) -> Strengths:
    """Measure how clearly a straight edge crosses the ground at the ends of vehicles.

    The strength is the median difference of colours across the edge, over the spread of that
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


def cut_chances(strengths: Strengths, proportions: Proportions) -> Chances:
    """Compute the chances ``[n]`` that an edge cuts the length of vehicles.

    Args:
        strengths: ``[n]`` strengths of the edges at their ends.
        proportions: ``[n]`` length over width of their bodies.
    """
    log_odds = (
        _LOG_ODDS
        + _LOG_ODDS_PER_STRENGTH * strengths
        + _LOG_ODDS_PER_LOG_PROPORTION * np.log(proportions)
    )
    # The fit had more cut cars than there are.
    log_odds += log_odds_of(_CUT_SHARE) - log_odds_of(_FITTED_SHARE)
    return chances_of(log_odds)


def hidden_errors(strengths: Strengths, chances: Chances) -> tuple[Errors, Errors]:
    """Compute the means ``[n]`` and standard deviations ``[n]`` of the errors of log lengths.

    Args:
        strengths: ``[n]`` strengths of the edges at their ends.
        chances: ``[n]`` chances that vehicles are cut.
    """
    means = chances * _HIDDEN_LOG_MEAN
    # Variance of a mixture: that of the cut ones, and that of not knowing which one it is.
    variances = chances * _HIDDEN_LOG_SD**2 + chances * (1 - chances) * _HIDDEN_LOG_MEAN**2
    excess = (strengths - _HALF_STRENGTH) / _STRENGTH_WIDTH
    edge_sds = _EDGE_LOG_SD * chances_of(excess)
    return means, np.sqrt(variances + edge_sds**2)


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
    # Medians, because other cars stand beside some rows.
    median = np.median(beside, axis=0)
    deviation = np.median(np.abs(beside - median), axis=0)
    contrast = np.linalg.norm(median, axis=-1)
    variation = SD_PER_MEDIAN_DEVIATION * np.linalg.norm(deviation, axis=-1)
    return np.asarray(contrast / (variation + _NOISE), np.float64)


def _strength_near(by_column: NDArray[np.float64], column: float) -> float:
    """Find the largest strength near a column; 0 outside the chip."""
    first = max(0, round(column) - _REACH_COLUMNS)
    last = round(column) + _REACH_COLUMNS + 1
    near = by_column[first:last]
    return float(near.max(initial=0.0))
