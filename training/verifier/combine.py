"""Combine detector and second look: ``python -m training.verifier.combine RUN``, after ``training.verifier.train``.

The combined score is the logistic of ``detector * logit(score) + look * logit + bias``; the three numbers are fitted on
the candidates of the held-out tenth, each set counting by the root of its number. Writes ``RUN/combination.json``.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnxruntime
from numpy.typing import ArrayLike, NDArray

from training.verifier.data import Candidates, load, middle

_RIDGE = 1e-3
_ITERATIONS = 30
_MARGIN = 1e-4  # scores of 0 and 1 have no logit


class Combination(NamedTuple):
    """Weights of the two opinions, and what is added."""

    detector: float
    look: float
    bias: float

    def score(self, scores: ArrayLike, logits: ArrayLike) -> NDArray[np.float64]:
        """Combined scores ``[n]`` in [0, 1] of the detector's scores and the second look's logits."""
        first = np.clip(np.asarray(scores, np.float64), _MARGIN, 1 - _MARGIN)
        total = self.detector * np.log(first / (1 - first)) + self.look * np.asarray(logits) + self.bias
        return np.asarray(1 / (1 + np.exp(-total)))


def fitted(scores: NDArray[np.float64], logits: NDArray[np.float64], found: Candidates) -> Combination:
    """Logistic regression by Newton's method."""
    first = np.clip(scores, _MARGIN, 1 - _MARGIN)
    design = np.column_stack([np.log(first / (1 - first)), logits, np.ones(len(first))])
    weight = np.zeros(len(first))
    for name in np.unique(found.sets):
        weight[found.sets == name] = 1 / np.sqrt((found.sets == name).sum())
    weight /= weight.sum()
    theta = np.array([1.0, 1.0, 0.0])
    for _ in range(_ITERATIONS):
        chance = 1 / (1 + np.exp(-design @ theta))
        slope = design.T @ (weight * (chance - found.car)) + _RIDGE * theta * (1, 1, 0)
        curve = (design * (weight * chance * (1 - chance))[:, None]).T @ design + _RIDGE * np.diag([1.0, 1.0, 1e-3])
        theta = theta - np.linalg.solve(curve, slope)
    return Combination(*(float(value) for value in theta))


def look(session: onnxruntime.InferenceSession, chips: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Logits of ``[n, 48, 48, 3]`` chips."""
    if not len(chips):
        return np.zeros(0)
    batch = np.ascontiguousarray(chips.transpose(0, 3, 1, 2)).astype(np.float32) / 255
    return np.asarray(session.run(["logit"], {"chips": batch})[0], np.float64)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    options = parser.parse_args()
    found = load(options.run / "held_out.npz")
    session = onnxruntime.InferenceSession(options.run / "verifier.onnx")
    combination = fitted(found.scores, look(session, middle(found.chips)), found)
    (options.run / "combination.json").write_text(json.dumps(combination._asdict()) + "\n")
    print(combination)


if __name__ == "__main__":
    main()
