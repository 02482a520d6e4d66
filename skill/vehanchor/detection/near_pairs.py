"""Pairs of points that lie near each other, by a grid of cells."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vehanchor.errors import ModelContractError

if TYPE_CHECKING:
    from numpy.typing import NDArray

_MOST_PAIRS = 60_000_000  # in neighbouring cells; a third of them are near
_BLOCK_PAIRS = 1 << 19  # that are compared at once, in 30 MiB
_MOST_CELLS = 1 << 20  # along a side


def near_pairs(
    first: NDArray[np.float64], second: NDArray[np.float64], reach: float
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Find all pairs with a distance of at most ``reach``.

    Three columns of three cells hold all neighbours of a point. The cells of a column are in sequence, so that searches
    in a sorted list find them. A k-d tree of ``scipy`` does the same, but its import takes a quarter of the time of a
    short command.

    Args:
        first: ``[n, 2]`` x, y.
        second: ``[m, 2]`` x, y.
        reach: largest distance, >= 0.

    Returns:
        Indices ``[k]`` into ``first`` and into ``second``, in no particular order.

    Raises:
        ModelContractError: too many points are near each other; time and memory grow with the square of their number.
    """
    none = np.zeros(0, np.intp)
    if not len(first) or not len(second):
        return none, none
    low = np.minimum(first.min(axis=0), second.min(axis=0))
    extent = float((np.maximum(first.max(axis=0), second.max(axis=0)) - low).max())
    side = max(reach, extent / _MOST_CELLS) or 1.0
    cells_a, cells_b = (np.floor((points - low) / side).astype(np.int64) for points in (first, second))
    column = int(extent / side) + 3  # cells; the first and the last are empty
    keys = cells_b @ [column, 1]
    order = np.argsort(keys, kind="stable")
    middles = cells_a @ [column, 1] + np.array([[-column], [0], [column]])
    starts, stops = np.searchsorted(keys[order], [middles - 1, middles + 2]).reshape(2, -1)
    ends = np.cumsum(stops - starts)
    if ends[-1] > _MOST_PAIRS:
        raise ModelContractError(
            f"more than {_MOST_PAIRS} pairs of the detector's {len(first)} boxes may overlap: it is not a vehicle "
            "detector, or min_score is too low"
        )
    found = [(none, none)]
    for block in range(0, int(ends[-1]), _BLOCK_PAIRS):
        pair = np.arange(block, min(block + _BLOCK_PAIRS, int(ends[-1])))
        place = np.searchsorted(ends, pair, side="right")
        i, j = place % len(first), order[stops[place] - ends[place] + pair]
        near = ((first[i] - second[j]) ** 2).sum(axis=1) <= reach**2
        found.append((i[near], j[near]))
    pairs_a, pairs_b = (np.concatenate(each) for each in zip(*found, strict=True))
    return pairs_a, pairs_b
