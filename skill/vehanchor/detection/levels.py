"""Search levels: the resolutions at which an image is searched, the vehicle lengths accepted, and the share of each."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vehanchor.scale.defaults import CAR_LENGTH_M
from vehanchor.scale.density import GRID

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

SEARCH_FACTORS = (1, 2, 4, 8)  # the levels 1/2, 1/4 and 1/8 add a third to the pixels
_SHARE_OF_ALL = 0.2  # share of the tiles that is split evenly, because the scene-scale prior may be wrong
MIN_LEVEL_SIDE_PX = 96  # reduced images with a shorter side are not searched: they would show one or two cars
LEVEL_OVERLAP = 1.25  # factor by which the length ranges of two levels overlap, for cars at their limit


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

    A vehicle is measured at the finest level at which it is within the model's training range: there it has the most
    pixels. Each coarser level therefore accepts lengths from half of that limit up, with an overlap, so that no fleet
    is split between two levels. Non-maximum suppression merges a vehicle found twice. The finest level has no lower
    limit and the coarsest no upper limit.

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
        if factor == 1 or (search_scales and min(width_px, height_px) // factor >= MIN_LEVEL_SIDE_PX)
    ]
    return [
        SearchLevel(
            factor,
            width_px // factor,
            height_px // factor,
            0.0 if factor == 1 else shortest,
            np.inf if factor == factors[-1] else longest,
        )
        for factor in factors
    ]


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
