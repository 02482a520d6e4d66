"""Limits of a search: which resolutions and how many tiles it visits, and where a caller may end it."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from vehanchor.options.method import Search

ANYTIME_PIXELS = 4_000_000
"""Smaller images are searched at every resolution that may show cars, unless tiles or seconds are limited."""

LARGE_PIXELS = 32_000_000
"""In larger images the interval decides when a search ends, in smaller ones the change of the value."""

WINDOWED_PIXELS = 16_000_000
"""Larger images are read ahead and previewed from overviews, because most of them are decoded in windows."""

_FAST_TILES = 0.05  # of all tiles, at most
_FAST_LEAST_TILES = 24
_FIRST_PAUSE, _FIRST_PAUSE_LARGE = 4, 16  # tiles
_GROWTH = 1.25  # of the number of visited tiles between pauses, so that few checks can end a search by chance


class Limits(NamedTuple):
    """Limits of a search.

    Attributes:
        every_level: whether to search resolutions at which the scene-scale prior excludes vehicles.
        max_tiles: maximum number of tiles; None for all.
        max_seconds: maximum duration; None for no limit.
        first_pause: number of visited tiles at which a caller may first end it; None for never.
    """

    every_level: bool
    max_tiles: int | None
    max_seconds: float | None
    first_pause: int | None

    @property
    def everything(self) -> bool:
        """Whether all tiles are visited."""
        return self.every_level and self.max_tiles is None and self.max_seconds is None


def search_limits(options: Search, n_pixels: int, n_tiles: int) -> Limits:
    """Choose the limits for an image by its size and the effort.

    Args:
        options: search options.
        n_pixels: number of pixels of the image.
        n_tiles: number of tiles at all resolutions.
    """
    everywhere, most = options.effort == "full", options.max_tiles
    if everywhere or n_pixels < ANYTIME_PIXELS:
        return Limits(everywhere, most, options.max_seconds, None)
    if options.effort == "fast":
        fast = max(_FAST_LEAST_TILES, round(_FAST_TILES * n_tiles))
        most = min(fast, most or fast)
    first = _FIRST_PAUSE if n_pixels < LARGE_PIXELS else _FIRST_PAUSE_LARGE
    return Limits(everywhere, most, options.max_seconds, first)


def next_pause(n_visited: int) -> int:
    """Compute the number of visited tiles at the next pause: 4 more, then a quarter more each time."""
    return max(n_visited + 4, round(n_visited * _GROWTH))
