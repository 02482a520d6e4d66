"""Layout of a component: places of its cameras in the pixels of one photograph.

Points are complex numbers: x to the right is the real part, y down is the imaginary part. A
similarity transform is then ``factor * point + shift``, and the argument of the factor is a turn.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import splu

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from vehanchor_flight.matching import Overlap

    Indices: TypeAlias = NDArray[np.intp]
    """Indices of photographs."""

    Numbers: TypeAlias = NDArray[np.complex128]
    """Points or similarity transforms as complex numbers."""

    Points: TypeAlias = NDArray[np.float64]
    """Points x, y ``[m, 2]``."""

    Offsets: TypeAlias = NDArray[np.float64]
    """Logs ``[m]`` of metres per pixel over those of the reference."""

    Weights: TypeAlias = NDArray[np.float64]
    """Weights ``[s]`` of the equations."""

    RealOrComplex: TypeAlias = NDArray[np.float64] | NDArray[np.complex128]
    """Values ``[s]`` of the pairs."""

    Lengths: TypeAlias = NDArray[np.float64]
    """Lengths in pixels or in diagonals of a photograph."""

_STEPS = 8  # Of the reweighted least squares.
_HEADING_REACH = 0.15  # Turns that are farther off lose weight; in lengths of a unit vector.
# Shifts that are farther off lose weight; in diagonals of a photograph. Walls and roofs cause
# smaller errors.
_SHIFT_REACH = 0.1
_REFERENCE_WEIGHT = 1e6  # Of the equation that fixes the reference, over all others together.


class Layout(NamedTuple):
    """Layout of a component.

    Attributes:
        feet: ``[m]`` points below the cameras in pixels of the reference, x to the right as real
            and y down as imaginary part; the reference is at 0.
        headings: ``[m]`` complex numbers of length 1 that turn directions in each photograph to
            those in the reference.
        off: ``[s]`` distance of each overlap's shift to the shift in the layout, in diagonals of a
            photograph.
    """

    feet: Numbers
    headings: Numbers
    off: Lengths


def lay_out(
    feet: Points,
    diagonals: Lengths,
    offsets: Offsets,
    reference: int,
    overlaps: Sequence[Overlap],
) -> Layout:
    """Lay out the photographs of a component by their overlaps.

    Single wrong overlaps have little weight.

    Args:
        feet: ``[m, 2]`` x, y below each camera in the photograph's own pixels; at nadir its centre.
        diagonals: ``[m]`` diagonal of each photograph in its own pixels.
        offsets: ``[m]`` logs of each member's metres per pixel over the reference's.
        reference: index of the photograph that sets pixel size and orientation of the layout.
        overlaps: link all members, by their indices; each weighs as much as it has matched points.

    Returns:
        The layout.
    """
    if not overlaps:
        at_reference = np.zeros(len(feet), np.complex128)
        unturned = np.ones(len(feet), np.complex128)
        return Layout(at_reference, unturned, off=np.zeros(0))
    first = [overlap.first for overlap in overlaps]
    second = [overlap.second for overlap in overlaps]
    pairs = _Pairs(
        n=len(feet),
        first=np.array(first),
        second=np.array(second),
        reference=reference,
    )
    # A link without matched points places a photograph that has no other.
    counts = [max(overlap.match.n, 1) for overlap in overlaps]
    n_matches = np.array(counts, dtype=np.float64)
    # Each overlap maps pixels of its first photograph to those of its second.
    matrices = np.array([overlap.match.turn for overlap in overlaps])
    transforms = matrices[:, 0] + 1j * matrices[:, 1]
    factors = transforms[:, 0]
    shifts = transforms[:, 2]
    # Rotations only: the graph of scales gives better lengths than single overlaps.
    turns = factors / np.abs(factors)
    own_feet = feet[:, 0] + 1j * feet[:, 1]
    # The first camera's foot, seen from that of the second, in pixels of the second.
    mapped_feet = factors * own_feet[pairs.first] + shifts
    steps = mapped_feet - own_feet[pairs.second]
    diagonals_in_layout = diagonals * np.exp(offsets)
    first_diagonals = diagonals_in_layout[pairs.first]
    second_diagonals = diagonals_in_layout[pairs.second]
    pair_diagonals = (first_diagonals + second_diagonals) / 2
    second_pixels = np.exp(offsets[pairs.second])
    zeros = np.zeros(len(overlaps))
    ones = np.ones(len(overlaps))
    weights = n_matches
    # Iteratively reweighted least squares: first the headings, then, with these, the positions.
    for _ in range(_STEPS):
        # heading_first = turn * heading_second; the reference has the heading 1.
        headings = pairs.solve(turns, zeros, weights=weights, reference_value=1.0)
        lengths = np.maximum(np.abs(headings), 1e-9)
        headings /= lengths
        # position_first - position_second = step, turned and scaled to the reference's pixels.
        first_headings = headings[pairs.first]
        second_headings = headings[pairs.second]
        steps_in_layout = second_headings * second_pixels * steps
        positions = pairs.solve(ones, steps_in_layout, weights=weights, reference_value=0.0)
        heading_errors = np.abs(first_headings - turns * second_headings)
        position_steps = positions[pairs.first] - positions[pairs.second]
        shift_errors = np.abs(position_steps - steps_in_layout)
        off = shift_errors / pair_diagonals
        # Weights of the Geman-McClure loss, one factor for turns and one for shifts.
        heading_penalty = 1 + (heading_errors / _HEADING_REACH) ** 2
        shift_penalty = 1 + (off / _SHIFT_REACH) ** 2
        penalty = heading_penalty * shift_penalty
        weights = n_matches / penalty**2
    return Layout(positions, headings, off=off)


class _Pairs(NamedTuple):
    """Pairs of photographs whose values are tied by linear equations.

    Attributes:
        n: number of photographs.
        first: ``[s]`` index of one photograph of each pair.
        second: ``[s]`` index of the other.
        reference: index of the photograph of known value.
    """

    n: int
    first: Indices
    second: Indices
    reference: int

    def solve(
        self,
        factors: RealOrComplex,
        targets: RealOrComplex,
        weights: Weights,
        reference_value: float,
    ) -> Numbers:
        """Solve ``v[first] - factor * v[second] = target`` by weighted least squares.

        Args:
            factors: ``[s]``.
            targets: ``[s]``.
            weights: ``[s]``.
            reference_value: value of the reference.

        Returns:
            ``[n]`` values of the photographs.
        """
        n_pairs = len(self.first)
        pair_rows = np.arange(n_pairs)
        # One row for each pair, with two values, and a last row that fixes the reference.
        rows = np.concatenate([pair_rows, pair_rows, [n_pairs]])
        columns = np.concatenate([self.first, self.second, [self.reference]])
        minus_factors = -factors.astype(np.complex128)
        ones = np.ones(n_pairs, np.complex128)
        values = np.concatenate([ones, minus_factors, [1.0]])
        entries = (values, (rows, columns))
        matrix = coo_matrix(entries, shape=(n_pairs + 1, self.n)).tocsr()
        reference_weight = _REFERENCE_WEIGHT * float(weights.sum())
        diagonal = diags(np.append(weights, reference_weight))
        complex_targets = targets.astype(np.complex128)
        right = np.append(complex_targets, reference_value)
        # Normal equations of complex least squares.
        adjoint = matrix.conj().T
        normal = (adjoint @ diagonal @ matrix).tocsc()
        weighted_right = adjoint @ (diagonal @ right)
        factorised = splu(normal)
        return np.asarray(factorised.solve(weighted_right))
