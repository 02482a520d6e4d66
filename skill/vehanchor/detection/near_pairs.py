"""Pairs of points that lie near each other, by a grid of cells."""

from __future__ import annotations

from itertools import pairwise
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
    counts = stops - starts
    edges = np.concatenate([[0], np.cumsum(counts)])
    n_pairs = int(edges[-1])
    if n_pairs > _MOST_PAIRS:
        raise ModelContractError(
            f"more than {_MOST_PAIRS} pairs of the detector's {len(first)} boxes may overlap: it is not a vehicle "
            "detector, or min_score is too low"
        )
    found = [(none, none)]
    (x_a, y_a), (x_b, y_b) = first.T, second[order].T
    blocks = np.searchsorted(edges, range(0, n_pairs + _BLOCK_PAIRS, _BLOCK_PAIRS))
    for begin, end in pairwise(np.minimum(blocks, len(counts))):
        place = np.repeat(np.arange(begin, end), counts[begin:end])
        i, j = place % len(first), (starts - edges[:-1])[place] + np.arange(edges[begin], edges[end])
        near = (x_a[i] - x_b[j]) ** 2 + (y_a[i] - y_b[j]) ** 2 <= reach**2
        found.append((i[near], order[j[near]]))
    pairs_a, pairs_b = (np.concatenate(each) for each in zip(*found, strict=True))
    return pairs_a, pairs_b
