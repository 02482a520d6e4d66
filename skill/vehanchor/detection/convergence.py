"""Stopping rules for the search of a large image: it ends when more tiles cannot narrow the scale's interval.

The uncertainty of a scale has two parts. More vehicles reduce the statistical part; the uncertainty of the fleet's
length remains. With the effort ``auto``, the search ends when the statistical part is below a third of the fleet's part
at two checks in a row, without doubts. The intervals between checks grow, so that few checks can end a search by
chance.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vehanchor.options.search import Search

ANYTIME_PIXELS = 16_000_000
"""Smaller images are searched at every resolution that may show cars, unless tiles or seconds are limited."""

_AUTO_SHARE, _AUTO_CHECKS = 1 / 3, 2
_FAST_SHARE, _FAST_CHECKS = 2 / 3, 1
_FAST_TILES = 0.05  # of all tiles, at most
_FAST_LEAST_TILES = 24
_LEAST_FLEET_LOG_SD = 0.03  # even a known fleet differs this much between parts of a town
_FIRST_CHECK, _GROWTH = 16, 1.25


class Convergence(NamedTuple):
    """Uncertainty of the scale from an unfinished search.

    Attributes:
        statistical_log_sd: log standard deviation from the number and the spread of the vehicles; inf without any.
        fleet_log_sd: log standard deviation from the fleet's unknown length.
        doubted: whether the scale is not usable yet, or there are doubts about the vehicles.
    """

    statistical_log_sd: float
    fleet_log_sd: float
    doubted: bool


class StopRule(NamedTuple):
    """Conditions that end a search.

    Attributes:
        share: limit of the statistical part as a share of the fleet's part; None for no such condition.
        checks: number of checks in a row at which the statistical part must be below the limit.
        max_tiles: maximum number of tiles; None for all.
        max_seconds: maximum duration; None for no limit.
        every_level: whether to search resolutions at which the scene-scale prior excludes vehicles.
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
    """Choose the stopping rule for an image by its size and the effort.

    Args:
        options: search options.
        n_pixels: number of pixels of the image.
        n_tiles: number of tiles at all resolutions.
    """
    everywhere = options.effort == "full"
    if everywhere or n_pixels < ANYTIME_PIXELS:
        return StopRule(None, 0, options.max_tiles, options.max_seconds, every_level=everywhere)
    if options.effort == "auto":
        return StopRule(_AUTO_SHARE, _AUTO_CHECKS, options.max_tiles, options.max_seconds)
    most = max(_FAST_LEAST_TILES, round(_FAST_TILES * n_tiles))
    return StopRule(_FAST_SHARE, _FAST_CHECKS, min(most, options.max_tiles or most), options.max_seconds)


def next_check(n_visited: int) -> int:
    """Compute the number of visited tiles at the next check: 16, then a quarter more each time."""
    return max(_FIRST_CHECK, n_visited + 4, round(n_visited * _GROWTH))


def has_converged(checks: Sequence[Convergence], rule: StopRule) -> bool:
    """Test whether more tiles cannot narrow the interval.

    Args:
        checks: results of all checks so far.
        rule: stopping rule.
    """
    if rule.share is None or len(checks) < rule.checks:
        return False
    return all(
        not each.doubted and each.statistical_log_sd < rule.share * max(each.fleet_log_sd, _LEAST_FLEET_LOG_SD)
        for each in checks[-rule.checks :]
    )
