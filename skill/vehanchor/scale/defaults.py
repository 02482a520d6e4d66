"""Defaults, and the words that options and records share."""

from __future__ import annotations

from typing import Literal

Aggregation = Literal["kde", "weighted_kde", "median", "mean"]
"""How lengths become one (see ``vehanchor.scale.lengths.modal_length``)."""

Stopped = Literal["all_searched", "settled", "max_tiles", "max_seconds"]
"""Why a search ended."""

NMS_IOU = 0.45  # paper, section III-B
OUTLIER_ALPHA = 1.5  # paper, equation 2

REGIONS = ("europe", "northern_europe", "north_america", "south_america", "south_asia")
"""Of whose cars the bundled detector knows the length; a model of somebody's own may know others."""

CAR_LENGTH_M = 4.6
"""Metres, of a car of any fleet, to a fifth: where only the resolution at which one is seen is asked for."""

LEAST_GSD_M_PER_PX, LARGEST_GSD_M_PER_PX = 1e-4, 1000.0
"""Ground sampling distances that a caller may give, metres per pixel: a tenth of a millimetre to a kilometre."""

LEAST_VEHICLE_M, LARGEST_VEHICLE_M = 2.0, 20.0
"""Lengths of vehicles, metres, from a quadricycle's (2.3 m) to a lorry's with its trailer (18.75 m in Europe)."""
