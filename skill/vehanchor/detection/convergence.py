"""When the search of a large image ends: when more tiles cannot narrow the interval of its scale any more.

An interval has a part that more vehicles narrow, and one that they do not: how long the cars of this fleet are. As soon
as the first is below a third of the second over two checks in a row, and nothing is in doubt, the search has said what
it can. Checks come ever more rarely, so that there are few at which chance could end a search too early.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.options.search import Search

ANYTIME_PIXELS = 16_000_000
"""Images of fewer pixels are searched at every resolution that may hold cars, unless tiles or seconds are limited."""

_AUTO_SHARE, _AUTO_CHECKS = 1 / 3, 2
_FAST_SHARE, _FAST_CHECKS = 2 / 3, 1
_FAST_TILES = 0.05  # of all tiles, at most
_FAST_LEAST_TILES = 24
_LEAST_FLEET_LOG_SD = 0.03  # a fleet that is known better still differs so much from quarter to quarter
_FIRST_CHECK, _GROWTH = 16, 1.25


class Convergence(NamedTuple):
    """What an unfinished search has reached.

    Attributes:
        statistical_log_sd: of the log of the scale, from the number and the spread of the vehicles; inf for none.
        fleet_log_sd: of the same, from not knowing the fleet.
        doubted: whether the scale could not be used as it stands, or something speaks against the vehicles.
    """

    statistical_log_sd: float
    fleet_log_sd: float
    doubted: bool


class StopRule(NamedTuple):
    """When to end.

    Attributes:
        share: of the fleet's part that the statistical part has to be below; None never ends for that.
        checks: in a row at which it has to be.
        max_tiles: to visit at most; None for all.
        max_seconds: to search at most; None for no limit.
        every_level: whether resolutions count at which, by the ground, no vehicle can be.
    """

    share: float | None
    checks: int
    max_tiles: int | None
    max_seconds: float | None
    every_level: bool = False

    @property
    def anytime(self) -> bool:
        """Whether the search may end before all tiles are visited."""
        return self.share is not None or self.max_tiles is not None or self.max_seconds is not None


def stop_rule(options: Search, n_pixels: int, n_tiles: int) -> StopRule:
    """Choose the rule for an image by its size and the caller's effort.

    Args:
        options: the caller's.
        n_pixels: of the image.
        n_tiles: in all.
    """
    everywhere = options.effort == "full"
    if everywhere or n_pixels < ANYTIME_PIXELS:
        return StopRule(None, 0, options.max_tiles, options.max_seconds, every_level=everywhere)
    if options.effort == "auto":
        return StopRule(_AUTO_SHARE, _AUTO_CHECKS, options.max_tiles, options.max_seconds)
    most = max(_FAST_LEAST_TILES, round(_FAST_TILES * n_tiles))
    return StopRule(_FAST_SHARE, _FAST_CHECKS, min(most, options.max_tiles or most), options.max_seconds)


def next_check(n_visited: int) -> int:
    """How many tiles are visited when it is checked again: 16, then a quarter more each time."""
    return max(_FIRST_CHECK, n_visited + 4, round(n_visited * _GROWTH))


def settled(standings: Sequence[Convergence], rule: StopRule) -> bool:
    """Whether more tiles cannot narrow the interval.

    Args:
        standings: at all checks so far.
        rule: when to end.
    """
    if rule.share is None or len(standings) < rule.checks:
        return False
    return all(
        not each.doubted and each.statistical_log_sd < rule.share * max(each.fleet_log_sd, _LEAST_FLEET_LOG_SD)
        for each in standings[-rule.checks :]
    )
