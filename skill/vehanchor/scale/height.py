"""Errors of a camera's height above the ground."""

from __future__ import annotations

import math

GROUND_LOG_SD = 0.12  # of a height above take-off: 10 to 15 % between the ground there and below
_HEIGHT_SD_M = 2.0  # barometer, and take-off from a hand or roof


def height_log_sd(height_m: float) -> float:
    """Compute the standard deviation of the log of a height above take-off."""
    return math.hypot(GROUND_LOG_SD, _HEIGHT_SD_M / height_m)
