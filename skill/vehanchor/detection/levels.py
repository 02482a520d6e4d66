"""Levels of a search: the resolutions of the image, and the vehicles that count at each."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from vehanchor.scale.defaults import CAR_LENGTH_M
from vehanchor.scale.density import GRID

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from vehanchor.scale.density import Density

    LengthRange: TypeAlias = tuple[float, float]
    """Shortest and longest vehicle, pixels."""

# The levels 1/2, 1/4 and 1/8 add a third to the pixels of full resolution.
SEARCH_FACTORS = (1, 2, 4, 8)
# Reduced images with a shorter side are not searched: they would show one or two cars.
MIN_LEVEL_SIDE_PX = 96
# Factor by which the length ranges of two levels overlap, for cars at their limit.
LEVEL_OVERLAP = 1.25
# Share of the tiles that is split evenly, because the scene-scale prior may be wrong.
_EVEN_SHARE = 0.2


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

    def accepts(self, lengths_px: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Test which vehicles are accepted, by their lengths in pixels of the reduced image."""
        is_long_enough = lengths_px >= self.shortest_px
        is_short_enough = lengths_px <= self.longest_px
        return is_long_enough & is_short_enough


def search_levels(
    width_px: int, height_px: int, length_range_px: LengthRange, *, search_scales: bool
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
    factors = [1]
    if search_scales:
        side_px = min(width_px, height_px)
        for factor in SEARCH_FACTORS[1:]:
            if side_px // factor >= MIN_LEVEL_SIDE_PX:
                factors.append(factor)
    _, longest = length_range_px
    levels = [
        SearchLevel(
            factor,
            width_px // factor,
            height_px=height_px // factor,
            shortest_px=longest / 2 / LEVEL_OVERLAP,
            longest_px=longest,
        )
        for factor in factors
    ]
    # No finer level takes shorter vehicles, and no coarser one longer ones.
    levels[0] = levels[0]._replace(shortest_px=0.0)
    levels[-1] = levels[-1]._replace(longest_px=np.inf)
    return levels


def level_chances(
    length_ranges_px: Mapping[int, LengthRange], density: Density
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
    # Each scale of the grid gives a car one length in pixels of the full image.
    car_lengths_px = CAR_LENGTH_M / np.exp(GRID)
    chances = {}
    for factor, (shortest, longest) in length_ranges_px.items():
        is_long_enough = car_lengths_px >= shortest * factor
        is_short_enough = car_lengths_px <= longest * factor
        fits = is_long_enough & is_short_enough
        chances[factor] = float(density[fits].sum())
    return chances


def level_shares(
    length_ranges_px: Mapping[int, LengthRange], density: Density | None
) -> dict[int, float]:
    """Compute each resolution's share of the tiles: by the probability of cars, plus an even part.

    Args:
        length_ranges_px: as in ``level_chances``.
        density: as in ``level_chances``; None without a prior.

    Returns:
        Shares by factor; their sum is 1.
    """
    even = 1.0 / len(length_ranges_px)
    chances = {}
    if density is not None:
        chances = level_chances(length_ranges_px, density)
    total = sum(chances.values())
    if total <= 0:
        return dict.fromkeys(length_ranges_px, even)
    return {
        factor: (1 - _EVEN_SHARE) * chance / total + _EVEN_SHARE * even
        for factor, chance in chances.items()
    }
