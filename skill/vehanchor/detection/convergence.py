"""Stopping rules for the search of an image: it ends when more tiles cannot change the scale.

With the effort ``auto``, the search of a photograph ends when the expected change of the value is small: the standard
error of the value by its vehicles, times the root of the share of vehicles in the tiles that are not visited. Few
vehicles that agree by chance do not end it.

The uncertainty of a scale has two parts. More vehicles reduce the statistical part; the uncertainty of the fleet's
length remains. The search of a large image ends when the statistical part is below a third of the fleet's part at two
checks in a row.

With doubts about the vehicles, or with a scale that more vehicles may make usable, no search ends early. The intervals
between checks grow, so that few checks can end a search by chance.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from vehanchor.options.search import Search

ANYTIME_PIXELS = 4_000_000
"""Smaller images are searched at every resolution that may show cars, unless tiles or seconds are limited."""

LARGE_PIXELS = 32_000_000
"""In larger images the interval decides, in smaller ones the change of the value."""

WINDOWED_PIXELS = 16_000_000
"""Larger images are read ahead and previewed from overviews, because most of them are decoded in windows."""

_FAST_TILES = 0.05  # of all tiles, at most
_FAST_LEAST_TILES = 24
_LEAST_FLEET_LOG_SD = 0.03  # even a known fleet differs this much between parts of a town
_GROWTH = 1.25  # of the number of visited tiles between checks
_CHANGE, _FAST_CHANGE = 0.0125, 0.025  # log standard deviations


class Convergence(NamedTuple):
    """Uncertainty of the scale from an unfinished search.

    Attributes:
        statistical_log_sd: log standard deviation from the number and the spread of the vehicles; inf without any.
        fleet_log_sd: log standard deviation from the fleet's unknown length.
        doubted: whether more vehicles may make the scale usable, or there are doubts about the vehicles.
        value_log_sd: log standard deviation of the value under resampling of the vehicles; inf for fewer than five.
        density: ``[g]`` density of the scale on ``vehanchor.scale.density.GRID``; None if the votes are uncalibrated.
        unseen_share: expected share of the image's vehicles in the tiles that are not visited.
    """

    statistical_log_sd: float
    fleet_log_sd: float
    doubted: bool
    value_log_sd: float = math.inf
    density: NDArray[np.float64] | None = None
    unseen_share: float = 1.0

    @property
    def change_log_sd(self) -> float:
        """Log standard deviation of the change that the unvisited tiles would make to the value."""
        return self.value_log_sd * math.sqrt(self.unseen_share)


class StopRule(NamedTuple):
    """Conditions that end a search.

    Attributes:
        share: limit of the statistical part as a share of the fleet's part; None if only tiles and seconds are limited.
        change: limit of the log standard deviation of the change that the unvisited tiles would make.
        checks: number of checks in a row at which the conditions must hold.
        first_check: number of visited tiles at the first check.
        max_tiles: maximum number of tiles; None for all.
        max_seconds: maximum duration; None for no limit.
        every_level: whether to search resolutions at which the scene-scale prior excludes vehicles.
    """

    share: float | None = None
    change: float = 0.0
    checks: int = 0
    first_check: int = 0
    max_tiles: int | None = None
    max_seconds: float | None = None
    every_level: bool = False

    @property
    def everything(self) -> bool:
        """Whether all tiles are visited."""
        return self.every_level and self.max_tiles is None and self.max_seconds is None


_PHOTOGRAPH = StopRule(share=2 / 3, change=_CHANGE, checks=1, first_check=4)
_PHOTOGRAPH_FAST = StopRule(share=1.0, change=_FAST_CHANGE, checks=1, first_check=4)
_LARGE = StopRule(share=1 / 3, change=math.inf, checks=2, first_check=16)
_LARGE_FAST = StopRule(share=2 / 3, change=math.inf, checks=1, first_check=16)


def stop_rule(options: Search, n_pixels: int, n_tiles: int) -> StopRule:
    """Choose the stopping rule for an image by its size and the effort.

    Args:
        options: search options.
        n_pixels: number of pixels of the image.
        n_tiles: number of tiles at all resolutions.
    """
    everywhere, seconds = options.effort == "full", options.max_seconds
    if everywhere or n_pixels < ANYTIME_PIXELS:
        return StopRule(max_tiles=options.max_tiles, max_seconds=seconds, every_level=everywhere)
    photograph = n_pixels < LARGE_PIXELS
    if options.effort == "auto":
        rule = _PHOTOGRAPH if photograph else _LARGE
        return rule._replace(max_tiles=options.max_tiles, max_seconds=seconds)
    most = max(_FAST_LEAST_TILES, round(_FAST_TILES * n_tiles))
    rule = _PHOTOGRAPH_FAST if photograph else _LARGE_FAST
    return rule._replace(max_tiles=min(most, options.max_tiles or most), max_seconds=seconds)


def next_check(n_visited: int) -> int:
    """Compute the number of visited tiles at the next check: 4 more, then a quarter more each time."""
    return max(n_visited + 4, round(n_visited * _GROWTH))


def is_narrow(check: Convergence, rule: StopRule) -> bool:
    """Test whether more tiles would change the interval and the value too little, doubts aside."""
    share = 0.0 if rule.share is None else rule.share
    narrow = check.statistical_log_sd < share * max(check.fleet_log_sd, _LEAST_FLEET_LOG_SD)
    return narrow and check.change_log_sd <= rule.change


def has_converged(checks: Sequence[Convergence], rule: StopRule) -> bool:
    """Test whether more tiles cannot change the scale.

    Args:
        checks: results of all checks so far.
        rule: stopping rule.
    """
    if rule.share is None or len(checks) < rule.checks:
        return False
    return all(not each.doubted and is_narrow(each, rule) for each in checks[-rule.checks :])
