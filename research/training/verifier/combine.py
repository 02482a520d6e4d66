"""Fit the weights of detector and verifier.

``python -m research.training.verifier.combine RUN OUT.onnx``, after ``train``.

The logit of a candidate's combined score is ``detector * logit(score) + verifier * logit + bias``.
The three numbers are fitted on the candidates of the held-out tenth, each set counting by the root
of its number, and become the metadata of ``OUT.onnx``. They are scaled so that 0.5 is where
``_CHANCE`` of the candidates are cars, and so that the hits' median score is what the detector
alone gives: whatever reads scores (confidence, weights of lengths) then reads the same.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path
from typing import TypeAlias

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from research.training.logistic import logistic, weight_of_sets
from research.training.onnx_file import LICENCE, write_metadata
from research.training.verifier.data import Candidates, load, middle
from vehanchor.detection.verifier import Weights

Logits: TypeAlias = NDArray[np.float64]
"""Logits of the candidates."""

# Chance from which a candidate is a car: a missed car costs less than a false one.
_CHANCE = 0.65
_RIDGE = 1e-3
_MIN_SCORE = 0.5
# Least score of the detector: none of 1,693 hits on the held-out tenth has less, but 44 % of the
# candidates have.
_MIN_DETECTOR_SCORE = 0.25


def _logit(chance: NDArray[np.float64]) -> NDArray[np.float64]:
    inside = np.clip(chance, 1e-4, 1 - 1e-4)
    return np.asarray(np.log(inside / (1 - inside)))


def fitted(logits: Logits, candidates: Candidates) -> Weights:
    """Fit the weights by logistic regression: the score is the chance of a car.

    Args:
        logits: ``[n]`` of the verifier.
        candidates: the candidates.
    """
    design = np.column_stack([_logit(candidates.scores), logits, np.ones(len(logits))])
    theta = logistic(design, candidates.car, weight=weight_of_sets(candidates.sets), ridge=_RIDGE)
    return Weights(*(float(value) for value in theta))


def rescaled(weights: Weights, logits: Logits, candidates: Candidates) -> Weights:
    """Rescale scores so that 0.5 and the median of the hits stay where they were, in order."""
    total = _logit(weights.score(candidates.scores, logits))
    limit = float(np.log(_CHANCE / (1 - _CHANCE)))
    ours = np.median(total[candidates.car & (total >= limit)]) - limit
    theirs = np.median(
        _logit(candidates.scores[candidates.car & (candidates.scores >= _MIN_SCORE)])
    )
    scale = float(theirs / ours)
    return Weights(
        weights.detector * scale, weights.verifier * scale, (weights.bias - limit) * scale
    )


def verifier_logits(
    session: onnxruntime.InferenceSession, chips: NDArray[np.uint8]
) -> NDArray[np.float64]:
    """Compute logits of ``[n, 48, 48, 3]`` chips."""
    if not len(chips):
        return np.zeros(0)
    batch = np.ascontiguousarray(chips.transpose(0, 3, 1, 2)).astype(np.float32) / 255
    return np.asarray(session.run(["logit"], {"chips": batch})[0], np.float64)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument(
        "--detector", default="vehicles", help="name of the detector whose candidates these are"
    )
    parser.add_argument("--size-weight", type=float, default=0.3, help="of the scene-scale prior")
    options = parser.parse_args()
    candidates = load(options.run / "held_out.npz")
    session = onnxruntime.InferenceSession(options.run / "verifier.onnx")
    logits = verifier_logits(session, middle(candidates.chips))
    chances = fitted(logits, candidates)
    weights = rescaled(chances, logits, candidates)._replace(size=options.size_weight)
    scores = weights.score(candidates.scores, logits)
    for name in np.unique(candidates.sets):
        hits, false = (
            scores[(candidates.sets == name) & (candidates.car == car)] >= _MIN_SCORE
            for car in (True, False)
        )
        print(
            f"{name}: {hits.sum()} of {len(hits)} cars, {false.sum()} of {len(false)} false alarms"
        )
    options.out.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(options.run / "verifier.onnx", options.out)
    metadata = {
        "description": "VehAnchor network that verifies a detector's candidates",
        "author": "VehAnchor",
        "license": LICENCE,
        "vehanchor.detector": options.detector,
        "vehanchor.weights": ",".join(f"{value:.4f}" for value in weights),
        "vehanchor.least_score": f"{_MIN_DETECTOR_SCORE:g}",
        "vehanchor.min_score": f"{_MIN_SCORE:g}",
    }
    write_metadata(options.out, metadata)
    print(chances, weights, f"{options.out}: {options.out.stat().st_size / 1e6:.2f} MB", sep="\n")


if __name__ == "__main__":
    main()
