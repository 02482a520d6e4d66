"""Defaults, and the words that options and records share."""

from __future__ import annotations

from typing import Literal

Aggregation = Literal["kde", "weighted_kde", "median", "mean"]
"""Rule for the modal length (see ``vehanchor.scale.lengths.modal_length``)."""

Preset = Literal["paper"]
"""Names of the presets."""

Stopped = Literal["all_searched", "converged", "max_tiles", "max_seconds"]
"""Why a search ended."""

USABLE_CHANCE = 0.9
"""Least chance of an error below 20 % for a usable scale: a planner acts if nine of ten cases are
right. A choice."""

Reason = Literal[
    "too_few",
    "too_coarse",
    "no_photograph",
    "oblique",
    "not_cars",
    "disagree",
    "assumed",
    "imprecise",
]
"""Why a scale is not usable."""

Remedy = Literal[
    "original",
    "aspect",
    "sides",
    "nadir",
    "lower",
    "visible",
    "perspective",
    "apart",
    "photograph",
    "vehicles",
    "facts",
    "drop",
    "add",
    "region",
    "line",
    "things",
    "length",
    "height",
    "images",
]
"""What a caller can do about a scale that is not usable (``vehanchor.records.advice``)."""

SHORT_SHA = 12
"""First digits of a file's SHA-256, by which messages and a scale to give back name the file."""

PROBABLY_RIGHT = 0.5
"""Chance from which a ruler counts as right in words and pictures."""

INTERVAL_PREMISE = "if at least one ruler is right"
"""Premise of the 95 % interval of a scale, wherever it is shown. The confidence also counts the
case that all rulers are wrong."""

NMS_IOU = 0.45
"""Overlap above which the box with the lower score is dropped (paper, section III-B)."""

OUTLIER_ALPHA = 1.5
"""Factor on the median length above which a vehicle is an outlier (paper, equation 2)."""

CAR_LENGTH_M = 4.6
"""Typical car length in metres, within 20 % for all fleets.

It is used only to choose resolutions and to weigh sizes.
"""

MIN_GSD_M_PER_PX = 1e-4
MAX_GSD_M_PER_PX = 1000.0
"""Limits of ground sampling distances from callers, metres per pixel."""

MIN_VEHICLE_M = 2.0
MAX_VEHICLE_M = 20.0
"""Limits of vehicle lengths, metres: in Europe a quadricycle has 2.3 m, a lorry with its trailer
18.75 m."""
