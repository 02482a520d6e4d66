"""Where a planner must not trust a scale: numbers alone, so that whoever only names them loads nothing."""

from __future__ import annotations

FALLBACK_CONFIDENCE = 0.5  # paper, section III-E: below it a planner must fall back
GUARD_GSD_M_PER_PX = 0.3  # paper, GSD_max
GUARD_CONFIDENCE = 0.3  # paper: C = min(C_raw, 0.3)
UNSURE_CONFIDENCE = 0.45  # where all rulers together leave more than a tenth to an error of a fifth and more
WIDEST_USABLE = 2.0  # high over low of an interval: beyond it a scale is not to be used
DISPUTE_CONFIDENCE = 0.4  # where it is open whether the dominant lengths are those of cars
