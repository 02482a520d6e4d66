"""Kinds that the chip network tells, their groups, and the sizes of the kinds' bodies."""

from __future__ import annotations

import numpy as np

from vehanchor.detection.chips import KINDS

CARS = KINDS[:7]
GROUPS = ("small", "car", "pickup", "van", "large", "other")
_GROUP_OF = {
    "kei": "small", "small": "small", "compact": "car", "saloon": "car", "suv": "car",
    "pickup": "pickup", "van": "van", "lorry": "large", "trailer": "large", "other": "other",
}  # fmt: skip
# These have too few readings for their own kind.
_READ = {"roof": "other", "container": "other", "boat": "other"}
# Length and width of each kind. An eye reads 4 to 5 % less width than tables of makes state.
BODY_M = {
    "kei": (3.40, 1.41), "small": (3.75, 1.55), "compact": (4.22, 1.65), "saloon": (4.68, 1.73),
    "suv": (4.57, 1.77), "pickup": (5.30, 1.90), "van": (4.80, 1.80),
}  # fmt: skip
GROUP_OF_KIND = np.array([GROUPS.index(_GROUP_OF[kind]) for kind in KINDS])
UNKNOWN = -1


def kind_index(read: str) -> int:
    """Return the index of a kind as the readings name it; -1 for unknown."""
    name = _READ.get(read, read)
    return KINDS.index(name) if name in KINDS else UNKNOWN
