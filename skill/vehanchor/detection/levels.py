"""The resolutions at which an image is searched, and the lengths of vehicles that count at each."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

SEARCH_FACTORS = (1, 2, 4, 8)  # the image is searched at 1/1, 1/2, 1/4 and 1/8: a third more pixels in all
MIN_LEVEL_SIDE_PX = 96  # a reduced image with a shorter side is not searched: it would hold a car or two
LEVEL_OVERLAP = 1.25  # factor by which the length ranges of two levels overlap: a car at their border is seen by both


class SearchLevel(NamedTuple):
    """One resolution at which an image is searched, and the lengths that count there.

    Attributes:
        factor: the image is reduced by it.
        width_px: columns of the reduced image.
        height_px: its rows.
        shortest_px: shortest vehicle that counts here, in pixels of the reduced image.
        longest_px: longest one.
    """

    factor: int
    width_px: int
    height_px: int
    shortest_px: float
    longest_px: float

    def counts(self, lengths_px: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which vehicles count here, by their lengths in pixels of the reduced image."""
        return (lengths_px >= self.shortest_px) & (lengths_px <= self.longest_px)


def search_levels(
    width_px: int, height_px: int, length_range_px: tuple[float, float], *, search_scales: bool
) -> list[SearchLevel]:
    """The resolutions at which an image is searched, finest first.

    A vehicle is measured at the finest level at which it is not longer than what the model was trained on: there it has
    the most pixels. So each coarser level counts the lengths from half of that limit up, less an overlap: a fleet at
    the border of two levels is cut off by neither, and boxes of one vehicle found twice are merged by the non-maximum
    suppression. The finest level has no lower and the coarsest no upper limit.

    Args:
        width_px: of the image.
        height_px: of the image.
        length_range_px: shortest and longest vehicle that the model was trained on.
        search_scales: False gives full resolution alone.

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
