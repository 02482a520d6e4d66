"""Look-alikes: equal things in rows, such as lorries, caravans and boats, which a detector takes for cars."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

_LEAST_VEHICLES = 20  # with which the spread is known to a sixth
_ALIKE_LOG_SPREAD = 0.045  # 99 of 100 fleets of the train split have 0.047 and more; equal things in rows 0.03 to 0.06
_EQUAL_LOG_SPREAD = 0.065  # equal things in rows have 0.03 to 0.06
_ALIKE_LOG_ODDS = 0.7  # standard deviation; fleets have 0.6 and more, caravans in rows 0.4 to 0.7
_UNLIKE_LOG_ODDS = -3.2  # mean; fleets of the train split have -2.9 and more, boats in rows -2.5 to -4.5
_QUARTILES_PER_SD = 1.349  # of a normal distribution


def look_alikes(lengths: ArrayLike, fleet_log_odds: ArrayLike | None) -> bool:
    """Test whether vehicles may be equal things that are no cars.

    One of three signs is enough, from 20 vehicles on: the log lengths spread (interquartile range over 1.349) by less
    than 0.045, as makes and models of cars do by 0.08; the log odds of the fleet's appearance
    (``vehanchor.detection.appearance``) spread by less than 0.7, and the log lengths by less than 0.065; the mean log
    odds are lower than in any fleet.

    Args:
        lengths: ``[n]`` pixels.
        fleet_log_odds: ``[m]`` of the vehicles with a chip; None without a fleet network.
    """
    values = np.asarray(lengths, dtype=np.float64)
    if len(values) < _LEAST_VEHICLES:
        return False
    low, high = np.percentile(np.log(values), [25, 75])
    spread = (high - low) / _QUARTILES_PER_SD
    odds = np.asarray([] if fleet_log_odds is None else fleet_log_odds, dtype=np.float64)
    if len(odds) < _LEAST_VEHICLES:
        return bool(spread < _ALIKE_LOG_SPREAD)
    alike = odds.std() < _ALIKE_LOG_ODDS and spread < _EQUAL_LOG_SPREAD
    return bool(spread < _ALIKE_LOG_SPREAD or alike or odds.mean() < _UNLIKE_LOG_ODDS)
