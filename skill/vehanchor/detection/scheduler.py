"""Scheduler of a large image's tiles, so that cars are found early, and limits of their number.

Each resolution continues with its most likely tile: first by the tile prior, later by the vehicles in neighbouring
tiles. Every fourth tile comes from a fixed order that spreads over the image. A resolution's share of the tiles follows
from the probability that cars fit it. The order depends only on the image.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Window
    from vehanchor.options.method import Search

ANYTIME_PIXELS = 4_000_000
"""Smaller images are searched at every resolution that may show cars, unless tiles or seconds are limited."""

LARGE_PIXELS = 32_000_000
"""In larger images the interval decides when a search ends, in smaller ones the change of the value."""

WINDOWED_PIXELS = 16_000_000
"""Larger images are read ahead and previewed from overviews, because most of them are decoded in windows."""

_FAST_TILES, _FAST_LEAST_TILES = 0.05, 24  # at most, of all tiles; in small images
_FIRST_PAUSE, _FIRST_PAUSE_LARGE = 4, 16  # tiles
_GROWTH = 1.25  # of the number of visited tiles between pauses, so that few checks can end a search by chance
_SPREAD_EVERY = 4  # one tile in four comes from the fixed order
_PRIOR_TILES = 2.0  # weight of the tile prior, in neighbours
_FULL_TILE = 4  # number of vehicles at which a tile counts in full
_NEAR_TILES = 1.1  # largest distance between the corners of neighbours, in tile sides
_CELL_LENGTHS = 3.0  # side of a cell in median lengths: nearly all boxes of one vehicle are in one cell
_PLASTIC = np.array([0.7548776662466927, 0.5698402909980532])
"""Roberts' sequence R2, of the plastic number: multiples of the two modulo 1 spread evenly over a plane."""


def most_tiles(options: Search, n_pixels: int, n_tiles: int) -> int:
    """Limit the number of tiles, of all tiles at all resolutions of an image."""
    most = min(n_tiles, options.max_tiles or n_tiles)
    if options.effort == "fast" and n_pixels >= ANYTIME_PIXELS:
        most = min(most, max(_FAST_LEAST_TILES, round(_FAST_TILES * n_tiles)))
    return most


def first_pause(options: Search, n_pixels: int) -> int | None:
    """Number of visited tiles at which a caller may first end the search of an image; None for never."""
    if options.effort == "full" or n_pixels < ANYTIME_PIXELS:
        return None
    return _FIRST_PAUSE if n_pixels < LARGE_PIXELS else _FIRST_PAUSE_LARGE


def next_pause(n_visited: int) -> int:
    """Compute the number of visited tiles at the next pause: 4 more, then a quarter more each time."""
    return max(n_visited + 4, round(n_visited * _GROWTH))


class TileScheduler:
    """Chooses the next tiles from the vehicles in the visited ones.

    Args:
        tiles: reduction factor of each tile of the image, and its window in pixels of the reduced image.
        priors: ``[n]`` probability that each tile shows cars, from a preview of the image.
        shares: share of the tiles for each resolution, by factor; tiles of other resolutions are never taken.
    """

    def __init__(
        self, tiles: Sequence[tuple[int, Window]], priors: NDArray[np.float64], shares: Mapping[int, float]
    ) -> None:
        self._factors = np.array([factor for factor, _ in tiles])
        self._corners = np.array([(window.x_px, window.y_px) for _, window in tiles], dtype=np.float64)
        self._reach = np.array([max(window.width_px, window.height_px) for _, window in tiles]) * _NEAR_TILES
        self._hits, self._seen = _PRIOR_TILES * priors, np.full(len(tiles), _PRIOR_TILES)
        self._shares = dict(shares)
        self._waiting = np.isin(self._factors, list(self._shares))
        self._taken = dict.fromkeys(self._shares, 0)
        self._rank = np.zeros(len(tiles))  # in the fixed order of a resolution
        for factor in self._shares:
            members = self._factors == factor
            at = np.column_stack([np.unique(side, return_inverse=True)[1] for side in self._corners[members].T])
            self._rank[members] = (0.5 + at @ _PLASTIC) % 1.0

    def next_tiles(self, count: int) -> list[int]:
        """Take up to ``count`` tiles; none are left when all are taken."""
        taken: list[int] = []
        while len(taken) < count and self._waiting.any():
            taken.append(self._next())
            self._waiting[taken[-1]] = False
        return taken

    def report(self, tile: int, n_vehicles: int) -> None:
        """Report the number of vehicles found in a tile."""
        near = (self._factors == self._factors[tile]) & (
            np.abs(self._corners - self._corners[tile]).max(axis=1) <= self._reach[tile]
        )
        self._hits[near] += min(1.0, n_vehicles / _FULL_TILE)
        self._seen[near] += 1.0

    def leave_out(self, factors: Collection[int]) -> None:
        """Take no more tiles of some resolutions."""
        self._waiting &= ~np.isin(self._factors, list(factors))

    @property
    def unseen_share(self) -> float:
        """Expected share of the vehicles in the tiles that are not taken."""
        weights = np.array([self._shares.get(int(factor), 0.0) for factor in self._factors])
        expected = weights * self._hits / self._seen
        return float(expected[self._waiting].sum() / max(expected.sum(), 1e-9))

    def _next(self) -> int:
        """Choose a tile of the resolution that is furthest behind its share."""
        open_factors = [factor for factor in self._shares if (self._waiting & (self._factors == factor)).any()]
        factor = min(open_factors, key=lambda each: ((self._taken[each] + 1) / self._shares[each], each))
        self._taken[factor] += 1
        chosen = np.flatnonzero(self._waiting & (self._factors == factor))
        if self._taken[factor] % _SPREAD_EVERY:
            likely = np.round(self._hits[chosen] / self._seen[chosen], 9)
            chosen = chosen[likely == likely.max()]
        return int(chosen[np.argmin(self._rank[chosen])])


def position_sample(boxes: NDArray[np.float64], least: int) -> NDArray[np.intp]:
    """Choose the candidates of some small cells, which spread evenly over a tile.

    The choice depends on the positions alone, so that it favours no score and no size. Boxes of one vehicle stay
    together, so that non-maximum suppression sees them all.

    Args:
        boxes: ``[n, 5]`` rows ``(x, y, length, width, angle)`` in pixels of the tile.
        least: cells are added until they hold so many candidates.

    Returns:
        Their indices in ascending order; all of them if there are no more than ``least``.
    """
    if len(boxes) <= least:
        return np.arange(len(boxes))
    cells = np.floor(boxes[:, :2] / (_CELL_LENGTHS * np.median(boxes[:, 2])))
    rank = (cells @ _PLASTIC) % 1.0
    return np.flatnonzero(rank <= np.partition(rank, least - 1)[least - 1])
