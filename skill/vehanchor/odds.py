"""Chances and their log odds."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

# Log odds below this have the chance of this, because the exponential would overflow.
_LEAST_LOG_ODDS = -700.0


def chance_of(log_odds: float) -> float:
    """Convert log odds to a chance, 0..1: the logistic function."""
    return 1.0 / (1.0 + math.exp(-max(log_odds, _LEAST_LOG_ODDS)))


def chances_of(log_odds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert log odds ``[n]`` to chances ``[n]``, 0..1: the logistic function."""
    bounded = np.maximum(log_odds, _LEAST_LOG_ODDS)
    return np.asarray(1.0 / (1.0 + np.exp(-bounded)))


def log_odds_of(chance: float) -> float:
    """Convert a chance above 0 and below 1 to log odds."""
    return math.log(chance / (1.0 - chance))
