"""Chances and their log odds."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray


def chances_of(log_odds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert log odds ``[n]`` to chances ``[n]``, 0..1."""
    # The logistic function, by a formula that does not overflow.
    return np.asarray((1.0 + np.tanh(log_odds / 2)) / 2)


def log_odds_of(chance: float) -> float:
    """Convert a chance above 0 and below 1 to log odds."""
    return math.log(chance / (1.0 - chance))
