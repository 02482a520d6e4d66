"""Layout of a component: places of its cameras in the pixels of one photograph."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import splu

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor_flight.matching import Overlap

_STEPS = 8  # of the reweighted least squares
_HEADING_REACH = 0.15  # of a unit vector: turns beyond lose weight
# of a photograph's diagonal: shifts beyond lose weight; walls and roofs cause smaller ones
_PLACE_REACH = 0.1


class Layout(NamedTuple):
    """Layout of a component.

    Attributes:
        feet: ``[m]`` points below the cameras in pixels of the reference, x to the right as real
            and y down as imaginary part; the reference is at 0.
        off: ``[s]`` distance of each overlap's shift to the shift in the layout, in diagonals of a
            photograph.
    """

    feet: NDArray[np.complex128]
    off: NDArray[np.float64]


def lay_out(
    feet: NDArray[np.float64],
    diagonals: NDArray[np.float64],
    offsets: NDArray[np.float64],
    reference: int,
    overlaps: Sequence[Overlap],
) -> Layout:
    """Lay out the photographs of a component by their overlaps; single wrong overlaps have little weight.

    Args:
        feet: ``[m, 2]`` x, y below each camera in the photograph's own pixels; at nadir its centre.
        diagonals: ``[m]`` diagonal of each photograph in its own pixels.
        offsets: ``[m]`` logs of each member's metres per pixel over the reference's.
        reference: index of the photograph that sets pixel size and orientation of the layout.
        overlaps: link all members, by their indices; each weighs as much as it has matched points.

    Returns:
        The layout.
    """
    m = len(feet)
    if not overlaps:
        return Layout(np.zeros(m, np.complex128), np.zeros(0))
    first, second = np.array([(each.first, each.second) for each in overlaps]).T
    weight = np.array([each.match.n for each in overlaps], dtype=np.float64)
    turns = np.array([each.match.turn[0] + 1j * each.match.turn[1] for each in overlaps])
    factor = turns[:, 0]
    shift = turns[:, 2]
    # a_first = a_second * turn, rotations only: the graph of scales gives better lengths
    unit = factor / np.abs(factor)
    own = feet[:, 0] + 1j * feet[:, 1]
    across = diagonals * np.exp(offsets)
    reach = (across[first] + across[second]) / 2
    ones = np.ones(len(overlaps))
    trust = weight
    for _ in range(_STEPS):
        headings = _tied(
            m,
            first,
            second=second,
            of_second=unit,
            target=0 * ones,
            weight=trust,
            reference=reference,
            fixed=1.0,
        )
        headings /= np.maximum(np.abs(headings), 1e-9)
        apart = (
            headings[second] * np.exp(offsets[second]) * (factor * own[first] + shift - own[second])
        )
        laid = _tied(
            m,
            first,
            second=second,
            of_second=ones,
            target=apart,
            weight=trust,
            reference=reference,
            fixed=0.0,
        )
        turned = np.abs(headings[first] - unit * headings[second])
        off = np.abs(laid[first] - laid[second] - apart) / reach
        trust = (
            weight / ((1 + (turned / _HEADING_REACH) ** 2) * (1 + (off / _PLACE_REACH) ** 2)) ** 2
        )
    return Layout(laid, off)


def _tied(
    m: int,
    first: NDArray[np.intp],
    second: NDArray[np.intp],
    of_second: NDArray[np.complex128] | NDArray[np.float64],
    target: NDArray[np.complex128] | NDArray[np.float64],
    weight: NDArray[np.float64],
    reference: int,
    fixed: float,
) -> NDArray[np.complex128]:
    """Solve ``v[first] - of_second * v[second] = target`` by least squares; the reference is fixed."""
    rows = np.arange(len(first))
    held = 1e6 * float(weight.sum())
    values = np.concatenate(
        [np.ones(len(first), np.complex128), -of_second.astype(np.complex128), [1.0]]
    )
    matrix = coo_matrix(
        (values, (np.r_[rows, rows, len(first)], np.r_[first, second, reference])),
        shape=(len(first) + 1, m),
    ).tocsr()
    weights = diags(np.r_[weight, held])
    adjoint = matrix.conj().T
    right = adjoint @ (weights @ np.r_[target.astype(np.complex128), fixed])
    return np.asarray(splu((adjoint @ weights @ matrix).tocsc()).solve(right))
