"""Candidate pairs of overlapping photographs.

Candidates come from features in the same cells of a hash, from neighbours by position, and from
neighbours in the order of exposure. Each source gives a bounded number of candidates per
photograph, so that their number grows linearly with the number of photographs.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor_flight.features import Features

    Pair: TypeAlias = tuple[int, int]
    """Indices of two photographs, the lower first."""

    Positions: TypeAlias = NDArray[np.float64]
    """Positions ``[n, 2]`` in metres."""

    Descriptors: TypeAlias = NDArray[np.float32]
    """Descriptors ``[v, d]`` of voters."""

    Owners: TypeAlias = NDArray[np.intp]
    """Index ``[v]`` of each voter's photograph."""

    Keys: TypeAlias = NDArray[np.int64]
    """Cells of a hash, or pairs of photographs as ``first * n + second``."""

_N_VOTERS = 200  # Features of a photograph that vote, the strongest.
_N_DIMENSIONS = 24
_N_BITS = 18
_N_TABLES = 6
_MAX_IN_CELL = 24  # A fuller cell holds what is everywhere, such as grass or gravel.
_N_BY_APPEARANCE = 8
_N_BY_POSITION = 6
_N_BY_ORDER = 2
_MIN_VOTES = 3
_SEED = 20261121


def candidate_pairs(features: Sequence[Features], positions: Positions | None = None) -> list[Pair]:
    """List the pairs of photographs to match.

    Args:
        features: of each photograph, in the order in which they were taken.
        positions: ``[n, 2]`` metres east and north, NaN for unknown positions; None if all are
            unknown.

    Returns:
        Sorted pairs of indices, the lower first.
    """
    n = len(features)
    pairs = _by_appearance(features)
    for step in range(1, _N_BY_ORDER + 1):
        pairs |= {(first, first + step) for first in range(n - step)}
    if positions is not None:
        pairs |= _by_position(positions)
    return sorted(pairs)


def _by_appearance(features: Sequence[Features]) -> set[Pair]:
    """Find the pairs whose features share cells most often."""
    n = len(features)
    n_voters = [min(len(own), _N_VOTERS) for own in features]
    owners = np.repeat(np.arange(n), n_voters)
    if n < 2 or len(owners) < 2:
        return set()
    descriptors = _principal_components(features)
    votes = _votes(descriptors, owners, n)
    # Both photographs of a pair name each other, with the most votes first.
    named: defaultdict[int, list[tuple[int, int]]] = defaultdict(list)
    for key, count in votes.items():
        first, second = divmod(key, n)
        if count >= _MIN_VOTES:
            named[first].append((-count, second))
            named[second].append((-count, first))
    pairs = set()
    for index, others in named.items():
        most_votes = sorted(others)[:_N_BY_APPEARANCE]
        for _, other in most_votes:
            pairs.add(_pair(index, other))
    return pairs


def _pair(index: int, other: int) -> Pair:
    """Put the lower of two indices first."""
    return min(index, other), max(index, other)


def _principal_components(features: Sequence[Features]) -> Descriptors:
    """Reduce the voters' descriptors to the dimensions in which they differ most, ``[v, d]``."""
    voters = [own.descriptors[:_N_VOTERS] for own in features]
    descriptors = np.concatenate(voters).astype(np.float32)
    descriptors -= descriptors.mean(axis=0)
    scatter = descriptors.T @ descriptors
    # The eigenvalues ascend, so the last axes have the most variance.
    _, axes = np.linalg.eigh(scatter)
    main_axes = axes[:, -_N_DIMENSIONS:]
    return np.asarray(descriptors @ main_axes)


def _votes(descriptors: Descriptors, owners: Owners, n: int) -> dict[int, int]:
    """Count the cells that photographs share, by locality-sensitive hashing.

    The cell of a descriptor is given by its signs in random directions. Similar descriptors often
    share a cell, and several tables find those that a single one separates.

    Args:
        descriptors: ``[v, d]`` voters.
        owners: ``[v]`` index of each voter's photograph.
        n: number of photographs.

    Returns:
        Votes by pair; the key of a pair is ``first * n + second``.
    """
    rng = np.random.default_rng(_SEED)
    bit_values = 1 << np.arange(_N_BITS)
    votes: Counter[int] = Counter()
    for _ in range(_N_TABLES):
        random_matrix = rng.normal(size=(_N_DIMENSIONS, _N_DIMENSIONS))
        rotation, _ = np.linalg.qr(random_matrix)
        directions = rotation[:, :_N_BITS].astype(np.float32)
        is_positive = descriptors @ directions > 0
        cells = is_positive @ bit_values
        pairs = _pairs_in_cells(cells, owners, n)
        keys, counts = np.unique(pairs, return_counts=True)
        counted = zip(keys.tolist(), counts.tolist(), strict=True)
        votes.update(dict(counted))
    return votes


def _pairs_in_cells(cells: Keys, owners: Owners, n: int) -> Keys:
    """List the pairs of photographs that share a cell, once for each shared cell.

    Args:
        cells: ``[v]`` cell of each voter.
        owners: ``[v]`` index of each voter's photograph.
        n: number of photographs.

    Returns:
        Keys ``first * n + second``.
    """
    order = np.lexsort((owners, cells))
    cells = cells[order]
    owners = owners[order]
    # A photograph counts once in a cell.
    is_new_cell = cells[1:] != cells[:-1]
    is_new_owner = owners[1:] != owners[:-1]
    is_new = np.append(True, is_new_cell | is_new_owner)
    cells = cells[is_new]
    owners = owners[is_new]
    # Leave out full cells.
    begins_cell = cells[1:] != cells[:-1]
    is_first = np.append(True, begins_cell)
    starts = np.flatnonzero(is_first)
    sizes = np.diff(starts, append=len(cells))
    sizes_of_voters = np.repeat(sizes, sizes)
    is_small = sizes_of_voters <= _MAX_IN_CELL
    cells = cells[is_small]
    owners = owners[is_small]
    # Members of a cell are neighbours now: compare each voter with the next, the next but one, ...
    keys = [np.zeros(0, np.int64)]
    n_steps = min(_MAX_IN_CELL, len(cells))
    for step in range(1, n_steps):
        is_same = cells[step:] == cells[:-step]
        if not is_same.any():
            break
        earlier = owners[:-step]
        later = owners[step:]
        first = earlier[is_same].astype(np.int64)
        keys.append(first * n + later[is_same])
    return np.concatenate(keys)


def _by_position(positions: Positions) -> set[Pair]:
    """Find the pairs of nearest neighbours."""
    from scipy.spatial import cKDTree

    is_known = np.isfinite(positions).all(axis=1)
    known = np.flatnonzero(is_known)
    if len(known) < 2:
        return set()
    known_positions = positions[known]
    # The nearest neighbour of a position is the position itself.
    n_neighbours = min(_N_BY_POSITION + 1, len(known))
    tree = cKDTree(known_positions)
    _, neighbours = tree.query(known_positions, k=n_neighbours)
    pairs = set()
    for own, others in enumerate(neighbours):
        for other in others:
            if other != own:
                first = int(known[own])
                second = int(known[other])
                pairs.add(_pair(first, second))
    return pairs
