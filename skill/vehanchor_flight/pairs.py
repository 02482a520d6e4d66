"""Candidate pairs of overlapping photographs: their number grows linearly with the number of photographs.

Candidates come from features in the same cells of a hash, from neighbours by position, and from
neighbours in the order of exposure. Each source gives a bounded number of candidates per
photograph.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor_flight.features import Features

_VOTERS = 200  # voting features per photograph
_DIMENSIONS = 24
_BITS = 18
_TABLES = 6
_MOST_IN_CELL = 24  # a fuller cell tells nothing: grass, gravel
_BY_LOOK = 8
_BY_PLACE = 6
_BY_ORDER = 2
_LEAST_VOTES = 3
_SEED = 20261121


def candidate_pairs(
    features: Sequence[Features], places: NDArray[np.float64] | None = None
) -> list[tuple[int, int]]:
    """List the pairs of photographs to match.

    Args:
        features: of each photograph, in the order in which they were taken.
        places: ``[n, 2]`` metres east and north, NaN for unknown positions; None if all are
            unknown.

    Returns:
        Sorted pairs of indices, the lower first.
    """
    n = len(features)
    pairs = {(first, first + step) for step in range(1, _BY_ORDER + 1) for first in range(n - step)}
    pairs |= _by_appearance(features)
    if places is not None:
        pairs |= _by_place(places)
    return sorted(pairs)


def _by_appearance(features: Sequence[Features]) -> set[tuple[int, int]]:
    """Find the pairs whose features share cells most often."""
    n = len(features)
    owners = np.concatenate(
        [np.full(min(len(each), _VOTERS), place) for place, each in enumerate(features)]
    )
    if n < 2 or len(owners) < 2:
        return set()
    described = np.concatenate([each.descriptors[:_VOTERS] for each in features]).astype(np.float32)
    described -= described.mean(axis=0)
    _, axes = np.linalg.eigh(described.T @ described)
    reduced = described @ axes[:, -_DIMENSIONS:]
    rng = np.random.default_rng(_SEED)
    votes: dict[int, int] = {}
    for _ in range(_TABLES):
        turn = np.linalg.qr(rng.normal(size=(_DIMENSIONS, _DIMENSIONS)))[0][:, :_BITS].astype(
            np.float32
        )
        cells = (reduced @ turn > 0) @ (1 << np.arange(_BITS))
        keys, counts = np.unique(_sharing(cells, owners, n), return_counts=True)
        for key, count in zip(keys.tolist(), counts.tolist(), strict=True):
            votes[key] = votes.get(key, 0) + count
    named: dict[int, list[tuple[int, int]]] = {}
    for key, count in votes.items():
        first, second = divmod(key, n)
        if count >= _LEAST_VOTES:
            named.setdefault(first, []).append((-count, second))
            named.setdefault(second, []).append((-count, first))
    return {
        (min(place, other), max(place, other))
        for place, others in named.items()
        for _, other in sorted(others)[:_BY_LOOK]
    }


def _sharing(cells: NDArray[np.int64], owners: NDArray[np.intp], n: int) -> NDArray[np.int64]:
    """List keys ``first * n + second`` of pairs of photographs, one for each cell that they share."""
    order = np.lexsort((owners, cells))
    cells = cells[order]
    owners = owners[order]
    # each photograph once per cell
    fresh = np.r_[True, (cells[1:] != cells[:-1]) | (owners[1:] != owners[:-1])]
    cells = cells[fresh]
    owners = owners[fresh]
    starts = np.flatnonzero(np.r_[True, cells[1:] != cells[:-1]])
    sizes = np.diff(np.r_[starts, len(cells)])
    size_of = np.repeat(sizes, sizes)
    cells = cells[size_of <= _MOST_IN_CELL]
    owners = owners[size_of <= _MOST_IN_CELL]
    keys = [np.zeros(0, np.int64)]
    for step in range(1, min(_MOST_IN_CELL, len(cells))):
        same = cells[step:] == cells[:-step]
        if not same.any():
            break
        keys.append(owners[:-step][same].astype(np.int64) * n + owners[step:][same])
    return np.concatenate(keys)


def _by_place(places: NDArray[np.float64]) -> set[tuple[int, int]]:
    from scipy.spatial import cKDTree

    known = np.flatnonzero(np.isfinite(places).all(axis=1))
    if len(known) < 2:
        return set()
    _, near = cKDTree(places[known]).query(places[known], k=min(_BY_PLACE + 1, len(known)))
    return {
        (int(min(known[place], known[other])), int(max(known[place], known[other])))
        for place, others in enumerate(near)
        for other in others
        if other != place
    }
