"""Layout of a component: places of its cameras in the pixels of one photograph."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import splu

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

_STEPS = 8  # of the reweighted least squares
_HEADING_REACH = 0.15  # of a unit vector: turns beyond lose weight
_PLACE_REACH = 0.1  # of a photograph's diagonal: shifts beyond lose weight; walls and roofs cause smaller ones


class Layout(NamedTuple):
    """Layout of a component.

    Attributes:
        feet: ``[m]`` points below the cameras in pixels of the reference, x to the right as real and y down as
            imaginary part; the reference is at 0.
        off: ``[s]`` distance of each seam's shift to the shift in the layout, in diagonals of a photograph.
    """

    feet: NDArray[np.complex128]
    off: NDArray[np.float64]


class Seam(NamedTuple):
    """Two overlapping photographs of a component.

    Attributes:
        first: index of one among the members.
        second: index of the other.
        turn: ``[2, 3]`` similarity transform from pixels of the first to pixels of the second.
        weight: number of matched points.
    """

    first: int
    second: int
    turn: NDArray[np.float64]
    weight: float


def lay_out(
    feet: NDArray[np.float64],
    diagonals: NDArray[np.float64],
    offsets: NDArray[np.float64],
    reference: int,
    seams: Sequence[Seam],
) -> Layout:
    """Lay out the photographs of a component by their overlaps; single wrong overlaps have little weight.

    Args:
        feet: ``[m, 2]`` x, y below each camera in the photograph's own pixels; at nadir its centre.
        diagonals: ``[m]`` diagonal of each photograph in its own pixels.
        offsets: ``[m]`` logs of each member's metres per pixel over the reference's.
        reference: index of the photograph that sets pixel size and orientation of the layout.
        seams: overlaps that link all members.

    Returns:
        The layout.
    """
    m = len(feet)
    if not seams:
        return Layout(np.zeros(m, np.complex128), np.zeros(0))
    first = np.array([seam.first for seam in seams])
    second = np.array([seam.second for seam in seams])
    weight = np.array([seam.weight for seam in seams], dtype=np.float64)
    factor = np.array([seam.turn[0, 0] + 1j * seam.turn[1, 0] for seam in seams])
    shift = np.array([seam.turn[0, 2] + 1j * seam.turn[1, 2] for seam in seams])
    # a_first = a_second * turn, rotations only: the graph of scales gives better lengths
    unit = factor / np.abs(factor)
    own = feet[:, 0] + 1j * feet[:, 1]
    across = diagonals * np.exp(offsets)
    reach = (across[first] + across[second]) / 2
    ones, nowhere = np.ones(len(seams)), np.zeros(len(seams))
    trust = weight
    for _ in range(_STEPS):
        headings = _tied(m, first, second, ones, unit, nowhere, trust, reference, 1.0)
        headings /= np.maximum(np.abs(headings), 1e-9)
        apart = headings[second] * np.exp(offsets[second]) * (factor * own[first] + shift - own[second])
        laid = _tied(m, first, second, ones, ones, apart, trust, reference, 0.0)
        turned = np.abs(headings[first] - unit * headings[second])
        off = np.abs(laid[first] - laid[second] - apart) / reach
        trust = weight / ((1 + (turned / _HEADING_REACH) ** 2) * (1 + (off / _PLACE_REACH) ** 2)) ** 2
    return Layout(laid, off)


def _tied(
    m: int,
    first: NDArray[np.intp],
    second: NDArray[np.intp],
    of_first: NDArray[np.float64],
    of_second: NDArray[np.complex128] | NDArray[np.float64],
    target: NDArray[np.complex128] | NDArray[np.float64],
    weight: NDArray[np.float64],
    reference: int,
    fixed: float,
) -> NDArray[np.complex128]:
    """Solve ``of_first * v[first] - of_second * v[second] = target`` by least squares; the reference is fixed."""
    rows = np.arange(len(first))
    held = 1e6 * float(weight.sum())
    values = np.concatenate([of_first.astype(np.complex128), -of_second.astype(np.complex128), [1.0]])
    matrix = coo_matrix(
        (values, (np.r_[rows, rows, len(first)], np.r_[first, second, reference])), shape=(len(first) + 1, m)
    ).tocsr()
    weights = diags(np.r_[weight, held])
    adjoint = matrix.conj().T
    right = adjoint @ (weights @ np.r_[target.astype(np.complex128), fixed])
    return np.asarray(splu((adjoint @ weights @ matrix).tocsc()).solve(right))
