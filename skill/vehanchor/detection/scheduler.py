"""Scheduler of a large image's tiles, so that cars are found early.

Each resolution continues with its most likely tile: first by the tile prior, later by the vehicles in neighbouring
tiles. Every fourth tile comes from a fixed order that spreads over the image. A resolution's share of the tiles follows
from the probability that cars fit it. The order depends only on the image.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.scale.defaults import CAR_LENGTH_M
from vehanchor.scale.density import GRID

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Window

_SHARE_OF_ALL = 0.2  # share of the tiles that is split evenly, because the scene-scale prior may be wrong
_SPREAD_EVERY = 4  # one tile in four comes from the fixed order
_PRIOR_TILES = 2.0  # weight of the tile prior, in neighbours
_FULL_TILE = 4  # number of vehicles at which a tile counts in full
_NEAR_TILES = 1.1  # largest distance between the corners of neighbours, in tile sides
PLASTIC = (0.7548776662466927, 0.5698402909980532)
"""Roberts' sequence R2, of the plastic number: multiples of the two modulo 1 spread evenly over a plane."""


class TilePlace(NamedTuple):
    """Tile at one resolution.

    Attributes:
        factor: reduction factor.
        window: in pixels of the reduced image.
    """

    factor: int
    window: Window


def level_chances(
    length_ranges_px: Mapping[int, tuple[float, float]], density: NDArray[np.float64]
) -> dict[int, float]:
    """Compute the probability that cars fit each resolution.

    Args:
        length_ranges_px: shortest and longest accepted vehicle at each resolution, pixels of the reduced image.
        density: ``[g]`` probabilities of the scale on ``vehanchor.scale.density.GRID``.

    Returns:
        Probabilities by factor. They need not sum to 1: neighbouring resolutions overlap, and at some scales cars fit
        none.
    """
    lengths = CAR_LENGTH_M / np.exp(GRID)
    return {
        factor: float(density[(lengths >= low * factor) & (lengths <= high * factor)].sum())
        for factor, (low, high) in length_ranges_px.items()
    }


def level_shares(
    length_ranges_px: Mapping[int, tuple[float, float]], density: NDArray[np.float64] | None
) -> dict[int, float]:
    """Compute each resolution's share of the tiles: by the probability that cars fit it, plus an even part.

    Args:
        length_ranges_px: as in ``level_chances``.
        density: as in ``level_chances``; None without a prior.

    Returns:
        Shares by factor; their sum is 1.
    """
    even = 1.0 / len(length_ranges_px)
    chances = {} if density is None else level_chances(length_ranges_px, density)
    total = sum(chances.values())
    if total <= 0:
        return dict.fromkeys(length_ranges_px, even)
    return {factor: (1 - _SHARE_OF_ALL) * mass / total + _SHARE_OF_ALL * even for factor, mass in chances.items()}


def spread_order(places: Sequence[TilePlace]) -> NDArray[np.intp]:
    """Order tiles of one resolution so that any number of the first ones spreads over the image.

    Args:
        places: the tiles.

    Returns:
        Their indices.
    """
    columns = {x: k for k, x in enumerate(sorted({place.window.x_px for place in places}))}
    rows = {y: k for k, y in enumerate(sorted({place.window.y_px for place in places}))}
    at = np.array([(columns[place.window.x_px], rows[place.window.y_px]) for place in places], dtype=np.float64)
    return np.argsort((0.5 + at @ np.array(PLASTIC)) % 1.0, kind="stable")


class TileScheduler:
    """Chooses the next tiles from the vehicles in the visited ones.

    Args:
        places: all tiles of the image.
        priors: ``[n]`` probability that each tile shows cars, from a preview of the image.
        shares: share of the tiles for each resolution, by factor; tiles of other resolutions are never taken.
    """

    def __init__(self, places: Sequence[TilePlace], priors: NDArray[np.float64], shares: Mapping[int, float]) -> None:
        self._factors = np.array([place.factor for place in places])
        self._corners = np.array([(place.window.x_px, place.window.y_px) for place in places], dtype=np.float64)
        self._reach = np.array([max(place.window.width_px, place.window.height_px) for place in places]) * _NEAR_TILES
        self._hits, self._seen = _PRIOR_TILES * priors, np.full(len(places), _PRIOR_TILES)
        self._shares = dict(shares)
        self._waiting = np.isin(self._factors, list(self._shares))
        self._taken = dict.fromkeys(self._shares, 0)
        self._spread: dict[int, list[int]] = {}
        self._rank = np.zeros(len(places), dtype=np.intp)
        for factor in self._shares:
            members = np.flatnonzero(self._factors == factor)
            ordered = members[spread_order([places[int(k)] for k in members])]
            self._spread[factor] = [int(k) for k in ordered[::-1]]
            self._rank[ordered] = np.arange(len(ordered))

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
        factor = self._next_factor()
        self._taken[factor] += 1
        if self._taken[factor] % _SPREAD_EVERY == 0:
            while True:
                tile = self._spread[factor].pop()
                if self._waiting[tile]:
                    return tile
        waiting = np.flatnonzero(self._waiting & (self._factors == factor))
        tile_prior = np.round(self._hits[waiting] / self._seen[waiting], 9)
        best = waiting[tile_prior == tile_prior.max()]
        return int(best[np.argmin(self._rank[best])])

    def _next_factor(self) -> int:
        """Choose the resolution that is furthest behind its share."""
        open_factors = [factor for factor in self._shares if (self._waiting & (self._factors == factor)).any()]
        return min(open_factors, key=lambda factor: ((self._taken[factor] + 1) / self._shares[factor], factor))
