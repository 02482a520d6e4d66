"""Levels and tiles of a search, and the order in which they are visited, so that cars are found early.

Each resolution continues with its most likely tile: first by the tile prior (towns have many edges,
fields few), later by the vehicles in neighbouring tiles. Every fourth tile comes from a fixed order
that spreads over the image. A resolution's share of the tiles follows from the probability that
cars fit it. The order depends only on the image.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from vehanchor.imagery.raster import Window
from vehanchor.imagery.tiles import read_preview
from vehanchor.scale.defaults import CAR_LENGTH_M
from vehanchor.scale.density import GRID

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping, Sequence

    from numpy.typing import NDArray

    from vehanchor.imagery.raster import Raster
    from vehanchor.options.method import Search

ANYTIME_PIXELS = 4_000_000
"""Smaller images are searched at every resolution that may show cars, unless tiles or seconds are limited."""

LARGE_PIXELS = 32_000_000
"""In larger images the interval decides when a search ends, in smaller ones the change of the value."""

WINDOWED_PIXELS = 16_000_000
"""Larger images are read ahead and previewed from overviews, because most of them are decoded in windows."""

# at most, of all tiles; in small images
_FAST_TILES = 0.05
_FAST_LEAST_TILES = 24
# tiles
_FIRST_PAUSE = 4
_FIRST_PAUSE_LARGE = 16
# of the number of visited tiles between pauses, so that few checks can end a search by chance
_GROWTH = 1.25
_SPREAD_EVERY = 4  # one tile in four comes from the fixed order
_PRIOR_TILES = 2.0  # weight of the tile prior, in neighbours
_FULL_TILE = 4  # number of vehicles at which a tile counts in full
_NEAR_TILES = 1.1  # largest distance between the corners of neighbours, in tile sides
# side of a cell in median lengths: nearly all boxes of one vehicle are in one cell
_CELL_LENGTHS = 3.0
_PLASTIC = np.array([0.7548776662466927, 0.5698402909980532])
"""Roberts' sequence R2, of the plastic number: multiples of the two modulo 1 spread evenly over a plane."""
SEARCH_FACTORS = (1, 2, 4, 8)  # the levels 1/2, 1/4 and 1/8 add a third to the pixels
# share of the tiles that is split evenly, because the scene-scale prior may be wrong
_SHARE_OF_ALL = 0.2
# reduced images with a shorter side are not searched: they would show one or two cars
MIN_LEVEL_SIDE_PX = 96
# factor by which the length ranges of two levels overlap, for cars at their limit
LEVEL_OVERLAP = 1.25
CELL_PX = 512
"""Side of the cells of a tile-prior map, pixels of the image."""
_PREVIEW_FACTOR = 8  # reduction factor of the preview
_CELL = CELL_PX // _PREVIEW_FACTOR
_BLOCK = 4 * _CELL  # pixels of the preview that are read at once: 2048 px of the image
# of a car, over the log gradient: research/training/tile_prior/fit.py
_ODDS_AT_ONE = -7.2
_ODDS_PER_LOG = 3.08
NOISE_GRADIENT = 0.5
"""Grey levels per pixel, the gradient of noise, added before the log is taken."""


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
        self._factors = np.array([factor for factor, _ in tiles])
        self._corners = np.array(
            [(window.x_px, window.y_px) for _, window in tiles], dtype=np.float64
        )
        self._reach = (
            np.array([max(window.width_px, window.height_px) for _, window in tiles]) * _NEAR_TILES
        )
        self._hits = _PRIOR_TILES * priors
        self._seen = np.full(len(tiles), _PRIOR_TILES)
        self._shares = dict(shares)
        self._waiting = np.isin(self._factors, list(self._shares))
        self._taken = dict.fromkeys(self._shares, 0)
        self._rank = np.zeros(len(tiles))  # in the fixed order of a resolution
        for factor in self._shares:
            members = self._factors == factor
            at = np.column_stack(
                [np.unique(side, return_inverse=True)[1] for side in self._corners[members].T]
            )
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
        open_factors = [
            factor for factor in self._shares if (self._waiting & (self._factors == factor)).any()
        ]
        factor = min(
            open_factors, key=lambda each: ((self._taken[each] + 1) / self._shares[each], each)
        )
        self._taken[factor] += 1
        chosen = np.flatnonzero(self._waiting & (self._factors == factor))
        if self._taken[factor] % _SPREAD_EVERY:
            likely = np.round(self._hits[chosen] / self._seen[chosen], 9)
            chosen = chosen[likely == likely.max()]
        return int(chosen[np.argmin(self._rank[chosen])])


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
    cells = np.floor(boxes[:, :2] / (_CELL_LENGTHS * np.median(boxes[:, 2])))
    rank = (cells @ _PLASTIC) % 1.0
    return np.flatnonzero(rank <= np.partition(rank, least - 1)[least - 1])


class SearchLevel(NamedTuple):
    """Resolution at which an image is searched, and the vehicle lengths accepted there.

    Attributes:
        factor: reduction factor.
        width_px: width of the reduced image.
        height_px: height of the reduced image.
        shortest_px: shortest accepted vehicle, in pixels of the reduced image.
        longest_px: longest accepted vehicle, in pixels of the reduced image.
    """

    factor: int
    width_px: int
    height_px: int
    shortest_px: float
    longest_px: float

    @property
    def shortest_own_px(self) -> float:
        """Shortest vehicle that no finer level accepts, in pixels of the reduced image."""
        return self.shortest_px * LEVEL_OVERLAP

    def counts(self, lengths_px: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Test which vehicles are accepted, by their lengths in pixels of the reduced image."""
        return (lengths_px >= self.shortest_px) & (lengths_px <= self.longest_px)


def search_levels(
    width_px: int, height_px: int, length_range_px: tuple[float, float], *, search_scales: bool
) -> list[SearchLevel]:
    """List the resolutions at which an image is searched, finest first.

    A vehicle is measured at the finest level at which it is within the model's training range:
    there it has the most pixels. Each coarser level therefore accepts lengths from half of that
    limit up, with an overlap, so that no fleet is split between two levels. Non-maximum suppression
    merges a vehicle found twice. The finest level has no lower limit and the coarsest no upper
    limit.

    Args:
        width_px: width of the image.
        height_px: height of the image.
        length_range_px: shortest and longest vehicle in the model's training data.
        search_scales: False gives full resolution only.

    Returns:
        Levels whose shorter side has at least 96 px; always full resolution.
    """
    longest = length_range_px[1]
    shortest = longest / 2 / LEVEL_OVERLAP
    factors = [
        factor
        for factor in SEARCH_FACTORS
        if factor == 1
        or (search_scales and min(width_px, height_px) // factor >= MIN_LEVEL_SIDE_PX)
    ]
    return [
        SearchLevel(
            factor,
            width_px // factor,
            height_px=height_px // factor,
            shortest_px=0.0 if factor == 1 else shortest,
            longest_px=np.inf if factor == factors[-1] else longest,
        )
        for factor in factors
    ]


def level_chances(
    length_ranges_px: Mapping[int, tuple[float, float]], density: NDArray[np.float64]
) -> dict[int, float]:
    """Compute the probability that cars fit each resolution.

    Args:
        length_ranges_px: shortest and longest accepted vehicle at each resolution, pixels of the
            reduced image.
        density: ``[g]`` probabilities of the scale on ``vehanchor.scale.density.GRID``.

    Returns:
        Probabilities by factor. They need not sum to 1: neighbouring resolutions overlap, and at
        some scales cars fit none.
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
    return {
        factor: (1 - _SHARE_OF_ALL) * mass / total + _SHARE_OF_ALL * even
        for factor, mass in chances.items()
    }


def gradient(coarse: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Compute the gradient of the grey levels at each pixel.

    Args:
        coarse: ``[h, w, 3]`` uint8 RGB.

    Returns:
        ``[h, w]`` grey levels per pixel.
    """
    grey = cv2.cvtColor(coarse, cv2.COLOR_RGB2GRAY).astype(np.float32)
    return np.asarray(
        np.hypot(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1)) / 8,
        np.float32,
    )


def car_prior(coarse: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Compute the probability of cars in each cell of a preview from its mean gradient.

    Args:
        coarse: ``[h, w, 3]`` uint8 RGB at an eighth of the image's resolution.

    Returns:
        ``[ceil(h / 64), ceil(w / 64)]`` in 0..1.
    """
    change = gradient(coarse)
    tops = range(0, change.shape[0], _CELL)
    lefts = range(0, change.shape[1], _CELL)
    means = np.array(
        [[change[y : y + _CELL, x : x + _CELL].mean() for x in lefts] for y in tops],
        dtype=np.float64,
    )
    return np.asarray(
        1 / (1 + np.exp(-(_ODDS_AT_ONE + _ODDS_PER_LOG * np.log(means + NOISE_GRADIENT))))
    )


def tile_prior_map(raster: Raster) -> NDArray[np.float64]:
    """Compute the probability of cars in each cell of an image.

    Args:
        raster: the image; at most 2048 x 2048 px of it are in memory.

    Returns:
        ``[rows, columns]`` of cells of 512 px in 0..1; one cell of 0 for an image with a side below
        8 px.
    """
    width = raster.width_px // _PREVIEW_FACTOR
    height = raster.height_px // _PREVIEW_FACTOR
    if not width or not height:
        return np.zeros((1, 1))
    rows = []
    for top in range(0, height, _BLOCK):
        parts = []
        for left in range(0, width, _BLOCK):
            window = Window(
                left, top, width_px=min(_BLOCK, width - left), height_px=min(_BLOCK, height - top)
            )
            parts.append(car_prior(read_preview(raster, window, _PREVIEW_FACTOR)))
        rows.append(np.concatenate(parts, axis=1))
    return np.concatenate(rows)


def tile_prior_of(cells: NDArray[np.float64], window: Window, factor: int) -> float:
    """Average the cells that a tile touches.

    Args:
        cells: result of ``tile_prior_map``.
        window: the tile, in pixels of the image reduced by ``factor``.
        factor: reduction factor of the tile's level.
    """
    rows, columns = cells.shape
    top = min(window.y_px * factor // CELL_PX, rows - 1)
    left = min(window.x_px * factor // CELL_PX, columns - 1)
    bottom = -(-(window.y_px + window.height_px) * factor // CELL_PX)
    right = -(-(window.x_px + window.width_px) * factor // CELL_PX)
    return float(cells[top : max(bottom, top + 1), left : max(right, left + 1)].mean())
