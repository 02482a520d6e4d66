"""Order in which the tiles of a search are visited, so that cars are found early, and its limits.

Each resolution continues with its most likely tile: first by the tile prior, later by the vehicles
in neighbouring tiles. Every fourth tile comes from a fixed order that spreads over the image. A
resolution's share of the tiles follows from the probability that cars fit it. The order depends
only on the image.
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
"""Smaller images are searched at every resolution with cars, up to the limits of the options."""

LARGE_PIXELS = 32_000_000
"""In larger images the interval decides when a search ends, in smaller ones the value's change."""

WINDOWED_PIXELS = 16_000_000
"""Larger images are read ahead and previewed from overviews: most are decoded in windows."""

# With the effort "fast", the share of all tiles that is visited at most, but not fewer than this.
_FAST_SHARE = 0.05
_FAST_MIN_TILES = 24

# Number of visited tiles at the first pause, in photographs and in large images.
_FIRST_PAUSE = 4
_FIRST_PAUSE_LARGE = 16
# Growth of the number of visited tiles from pause to pause: few checks, so that few end by chance.
_PAUSE_GROWTH = 1.25
_MIN_TILES_BETWEEN_PAUSES = 4

# One tile in four comes from the fixed order, whatever the other tiles showed.
_SPREAD_EVERY = 4
# Weight of the tile prior against the neighbours, in visited neighbours.
_PRIOR_WEIGHT = 2.0
# Number of vehicles at which a tile counts as full of cars.
_FULL_TILE_VEHICLES = 4
# Largest distance between the corners of neighbours, in tile sides.
_NEIGHBOUR_SIDES = 1.1
# Side of a sampling cell in median lengths: nearly all boxes of one vehicle are in one cell.
_SAMPLE_CELL_LENGTHS = 3.0
_PLASTIC = np.array([0.7548776662466927, 0.5698402909980532])
"""Roberts' sequence R2 (plastic number): its multiples modulo 1 spread evenly over a plane."""


def most_tiles(options: Search, n_pixels: int, n_tiles: int) -> int:
    """Limit the number of tiles, of all tiles at all resolutions of an image."""
    limit = n_tiles
    if options.max_tiles:
        limit = min(limit, options.max_tiles)
    if options.effort == "fast" and n_pixels >= ANYTIME_PIXELS:
        fast_tiles = round(_FAST_SHARE * n_tiles)
        limit = min(limit, max(_FAST_MIN_TILES, fast_tiles))
    return limit


def first_pause(options: Search, n_pixels: int) -> int | None:
    """Compute the number of visited tiles at which a search may first end early; None for never."""
    if options.effort == "full" or n_pixels < ANYTIME_PIXELS:
        return None
    if n_pixels < LARGE_PIXELS:
        return _FIRST_PAUSE
    return _FIRST_PAUSE_LARGE


def next_pause(n_visited: int) -> int:
    """Compute the number of visited tiles at the next pause: a quarter more, at least 4 more."""
    grown = round(n_visited * _PAUSE_GROWTH)
    return max(n_visited + _MIN_TILES_BETWEEN_PAUSES, grown)


class TileScheduler:
    """Chooses the next tiles from the vehicles in the visited ones.

    The chance that a tile shows cars is estimated as ``(w p + h) / (w + n)``: p is its tile prior
    with the weight w, and h of its n visited neighbours were full of vehicles.

    Args:
        tiles: reduction factor of each tile of the image, and its window in pixels of the reduced
            image.
        priors: ``[n]`` probability that each tile shows cars, from a preview of the image.
        shares: share of the tiles for each resolution, by factor; tiles of other resolutions are
            never taken.
    """

    def __init__(
        self,
        tiles: Sequence[tuple[int, Window]],
        priors: NDArray[np.float64],
        shares: Mapping[int, float],
    ) -> None:
        factors = []
        corners = []
        sides = []
        for factor, window in tiles:
            factors.append(factor)
            corners.append((window.x_px, window.y_px))
            sides.append(max(window.width_px, window.height_px))
        self._factors = np.array(factors)
        self._corners = np.array(corners, dtype=np.float64)
        self._reach = np.array(sides) * _NEIGHBOUR_SIDES
        self._hits = _PRIOR_WEIGHT * priors
        self._trials = np.full(len(tiles), _PRIOR_WEIGHT)
        self._shares = dict(shares)
        self._waiting = np.isin(self._factors, list(self._shares))
        self._n_taken = dict.fromkeys(self._shares, 0)
        # Rank of a tile in the fixed order of its resolution.
        self._rank = np.zeros(len(tiles))
        for factor in self._shares:
            members = self._factors == factor
            x, y = self._corners[members].T
            _, columns = np.unique(x, return_inverse=True)
            _, rows = np.unique(y, return_inverse=True)
            columns_and_rows = np.column_stack([columns, rows])
            self._rank[members] = (0.5 + columns_and_rows @ _PLASTIC) % 1.0

    def next_tiles(self, count: int) -> list[int]:
        """Take up to ``count`` tiles; none are left when all are taken."""
        taken: list[int] = []
        while len(taken) < count and self._waiting.any():
            tile = self._next_tile()
            self._waiting[tile] = False
            taken.append(tile)
        return taken

    def report(self, tile: int, n_vehicles: int) -> None:
        """Report the number of vehicles found in a tile."""
        offsets = np.abs(self._corners - self._corners[tile])
        near = offsets.max(axis=1) <= self._reach[tile]
        near &= self._factors == self._factors[tile]
        self._hits[near] += min(1.0, n_vehicles / _FULL_TILE_VEHICLES)
        self._trials[near] += 1.0

    def leave_out(self, factors: Collection[int]) -> None:
        """Take no more tiles of some resolutions."""
        self._waiting &= ~np.isin(self._factors, list(factors))

    @property
    def unseen_share(self) -> float:
        """Expected share of the vehicles in the tiles that are not taken."""
        factors = self._factors.tolist()
        weights = np.array([self._shares.get(factor, 0.0) for factor in factors])
        expected = weights * self._hits / self._trials
        unseen = expected[self._waiting].sum()
        return float(unseen / max(expected.sum(), 1e-9))

    def _next_tile(self) -> int:
        """Choose a tile of the resolution that is furthest behind its share."""
        factor = self._next_factor()
        self._n_taken[factor] += 1
        candidates = np.flatnonzero(self._is_waiting(factor))
        if self._n_taken[factor] % _SPREAD_EVERY:
            chances = self._hits[candidates] / self._trials[candidates]
            # Rounding makes equal chances equal, whatever the order of the reports.
            chances = np.round(chances, 9)
            candidates = candidates[chances == chances.max()]
        first = np.argmin(self._rank[candidates])
        return int(candidates[first])

    def _is_waiting(self, factor: int) -> NDArray[np.bool_]:
        """Mark the waiting tiles ``[n]`` of a resolution."""
        return np.asarray(self._waiting & (self._factors == factor))

    def _next_factor(self) -> int:
        """Choose the resolution with waiting tiles that is furthest behind its share."""

        def progress(factor: int) -> tuple[float, int]:
            n_then = self._n_taken[factor] + 1
            return n_then / self._shares[factor], factor

        waiting = [factor for factor in self._shares if self._is_waiting(factor).any()]
        return min(waiting, key=progress)


def position_sample(boxes: NDArray[np.float64], least: int) -> NDArray[np.intp]:
    """Choose the candidates of some small cells, which spread evenly over a tile.

    The choice depends on the positions alone, so that it favours no score and no size. Boxes of one
    vehicle stay together, so that non-maximum suppression sees them all.

    Args:
        boxes: ``[n, 5]`` rows ``(x, y, length, width, angle)`` in pixels of the tile.
        least: cells are added until they hold so many candidates.

    Returns:
        Their indices in ascending order; all of them if there are no more than ``least``.
    """
    if len(boxes) <= least:
        return np.arange(len(boxes))
    cell_px = _SAMPLE_CELL_LENGTHS * np.median(boxes[:, 2])
    cells = np.floor(boxes[:, :2] / cell_px)
    # Candidates of one cell have one rank, and the lowest ranks spread evenly.
    rank = (cells @ _PLASTIC) % 1.0
    lowest = np.partition(rank, least - 1)
    limit = lowest[least - 1]
    return np.flatnonzero(rank <= limit)
