"""Logistic regression, and the area under the ROC curve."""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Weights: TypeAlias = NDArray[np.float64]
    """Weights ``[n]`` of the cases."""

    Values: TypeAlias = NDArray[np.float64]
    """Values ``[n]`` of a score."""

_ITERATIONS = 30


def logistic(
    design: NDArray[np.float64],
    car: NDArray[np.bool_],
    weight: Weights,
    ridge: float = 1e-6,
) -> NDArray[np.float64]:
    """Fit log odds ``design @ theta`` by Newton's method.

    Args:
        design: ``[n, k]``; its last column is 1 for the constant term.
        car: ``[n]`` what happened.
        weight: ``[n]``, of sum 1.
        ridge: penalty on the square of each slope.

    Returns:
        ``[k]`` weights of the columns.
    """
    theta = np.zeros(design.shape[1])
    penalty = np.append(np.full(len(theta) - 1, ridge), 1e-6)
    for _ in range(_ITERATIONS):
        chance = 1 / (1 + np.exp(-np.clip(design @ theta, -30, 30)))
        slope = design.T @ (weight * (chance - car)) + penalty * theta
        spread = weight * chance * (1 - chance)
        curve = (design * spread[:, None]).T @ design + np.diag(penalty)
        theta = theta - np.linalg.solve(curve, slope)
    return theta


def weight_of_sets(sets: NDArray[np.str_]) -> Weights:
    """Compute weights ``[n]`` of sum 1: each set counts by the root of its number."""
    _, number, counts = np.unique(sets, return_inverse=True, return_counts=True)
    weight = (1 / np.sqrt(counts))[number]
    return np.asarray(weight / weight.sum())


def area(hits: Values, false: Values) -> float:
    """Compute the area under the ROC curve."""
    values = np.concatenate([hits, false])
    order = np.argsort(values, kind="stable")
    rank = np.argsort(order, kind="stable")
    # The mean rank of the hits above the one that they have without any false value below them.
    surplus = rank[: len(hits)].mean() - (len(hits) - 1) / 2
    return float(surplus / len(false))
