"""Look-alikes: equal things in rows, such as lorries, caravans and boats, which a detector takes for cars."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from vehanchor.detection.detections import Looks

_LEAST_VEHICLES = 20  # with which the spread is known to a sixth
_EQUAL_LENGTHS = 0.045  # spread of log lengths; 3 of 204 fleets have less
_EQUAL_LOOKS = 0.04  # spread of log lengths by appearance; none of those three has less
_LEAST_LOGIT = 2.0  # mean; 203 of 204 fleets have more
_QUARTILES_PER_SD = 1.349  # of a normal distribution


def look_alikes(lengths: ArrayLike, looks: Looks | None) -> bool:
    """Test whether vehicles may be equal things that are no cars.

    One of two signs is enough, from 20 vehicles on: their lengths and their looks spread less than those of cars of
    different makes (interquartile range over 1.349), or they look less like cars than any fleet.

    Args:
        lengths: ``[n]`` pixels.
        looks: of the vehicles that have any; None without a chip network.
    """
    values = np.asarray(lengths, dtype=np.float64)
    if len(values) < _LEAST_VEHICLES:
        return False
    equal = _spread(np.log(values)) < _EQUAL_LENGTHS
    if looks is None or len(looks) < _LEAST_VEHICLES:
        return bool(equal)
    return bool(looks.logits.mean() < _LEAST_LOGIT or (equal and _spread(looks.log_lengths) < _EQUAL_LOOKS))


def _spread(values: NDArray[np.float64]) -> float:
    low, high = np.percentile(values, [25, 75])
    return float(high - low) / _QUARTILES_PER_SD
