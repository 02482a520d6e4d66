"""Uncertainty of a positive quantity, in log space, with a side below and a side above.

The interval of a scale is often skewed. A symmetric standard deviation would move both of its ends, so a distance would
contradict the scale that it rests on. Errors of other sources are added to each side.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from vehanchor.scale.lengths import Z95, Interval


class Spread(NamedTuple):
    """Standard deviations of the log of a quantity.

    Attributes:
        below: towards smaller values.
        above: towards larger values.
    """

    below: float = 0.0
    above: float = 0.0

    @classmethod
    def of_interval(cls, value: float, low: float | None, high: float | None) -> Spread:
        """Convert a 95 % interval; without one, or with a value at an end, the side is 0."""
        if not (value and low and high):
            return cls()
        return cls(max(math.log(value / low), 0.0) / Z95, max(math.log(high / value), 0.0) / Z95)

    def times(self, factor: float) -> Spread:
        """Return the spread of a power of the quantity, or of the quantity with its relative error multiplied."""
        return Spread(self.below * factor, self.above * factor)

    def plus(self, log_sd: float) -> Spread:
        """Add an independent symmetric error to each side."""
        return Spread(math.hypot(self.below, log_sd), math.hypot(self.above, log_sd))

    def around(self, value: float) -> Interval:
        """Return the 95 % interval around a value."""
        return Interval(value * math.exp(-Z95 * self.below), value * math.exp(Z95 * self.above))
