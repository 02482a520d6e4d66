"""Thresholds of the confidence; this module imports nothing, so that it loads fast."""

from __future__ import annotations

FALLBACK_CONFIDENCE = 0.5  # paper, section III-E: with less a planner must fall back
GUARD_GSD_M_PER_PX = 0.3  # paper, GSD_max
GUARD_CONFIDENCE = 0.3  # paper: C = min(C_raw, 0.3)
UNSURE_CONFIDENCE = 0.45  # maximum if an error above 20 % has a probability above 0.1
WIDEST_USABLE = 2.0  # largest ratio of an interval's ends for a usable scale
DISPUTE_CONFIDENCE = 0.4  # maximum if it is doubtful that the vehicles are cars
