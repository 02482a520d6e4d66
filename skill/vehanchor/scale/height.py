"""Errors of a camera's height above the ground."""

from __future__ import annotations

import math

GIVEN_HEIGHT_LOG_SD = 0.05  # of a given height: the caller knows the height above the ground itself
GROUND_LOG_SD = 0.12  # of a height above take-off: the ground below is not the ground of the take-off, 10 to 15 %
_HEIGHT_SD_M = 2.0  # barometer and the height of the hand or roof it started from


def height_log_sd(height_m: float) -> float:
    """Standard deviation of the log of a height above take-off."""
    return math.hypot(GROUND_LOG_SD, _HEIGHT_SD_M / height_m)
