"""Measure the benefit of the scene-scale prior's size odds.

``python -m research.training.verifier.sizes``, for ``combine --size-weight``.

Searches the held-out tenth of the labelled images and of the scenery with the bundled networks and prints, for each
weight of ``SceneScalePrior.size_odds`` in a candidate's score, how many cars come before the so-manieth false alarm.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from research.training.detector.data import load_train_images
from research.training.detector.scenery import load_scenery
from research.training.verifier.data import truth_of
from vehanchor.detection.detector import Detector
from vehanchor.detection.scene_scale import load_scene_scale
from vehanchor.detection.search import search
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.zoo import resolve_model
from vehanchor.options import Search

_LEAST_SCORE = 0.2
_WEIGHTS = (0.0, 0.2, 0.3, 0.4, 0.5, 0.7, 1.0)
_FALSE_ALARMS = (200, 100, 50, 25, 12)


class SizedCandidates(NamedTuple):
    """Candidates scored without size odds, and their size odds.

    Attributes:
        logits: ``[n]`` of their scores.
        size_odds: ``[n]``.
        car: ``[n]`` bool.
    """

    logits: NDArray[np.float64]
    size_odds: NDArray[np.float64]
    car: NDArray[np.bool_]


def hits_before(found: SizedCandidates, weight: float) -> dict[int, int]:
    """Count the cars that score above the n-th false alarm, for each n."""
    scores = found.logits + weight * found.size_odds
    false = np.sort(scores[~found.car])[::-1]
    return {most: int((scores[found.car] > false[most]).sum()) for most in _FALSE_ALARMS if most < len(false)}


def searched(data: Path) -> SizedCandidates:
    """All candidates of the held-out tenth."""
    detector, ground = Detector(resolve_model()), load_scene_scale()
    assert ground is not None
    logits, odds, car = [np.zeros(0)], [np.zeros(0)], [np.zeros(0, bool)]
    for sample in load_train_images(data / "vehicles", held_out=True) + load_scenery(data, held_out=True):
        with open_raster(sample.image) as raster:
            scene = ground.predict(raster)
            found = search(raster, detector, Search(min_score=_LEAST_SCORE))
        truth = truth_of(found.boxes, sample.boxes, sample.ignore)
        judged = truth >= 0
        scores = np.clip(found.scores[judged], 1e-4, 1 - 1e-4)
        logits.append(np.log(scores / (1 - scores)))
        odds.append(scene.size_odds(found.boxes[judged, 2]))
        car.append(truth[judged] == 1)
    return SizedCandidates(np.concatenate(logits), np.concatenate(odds), np.concatenate(car))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    options = parser.parse_args()
    found = searched(options.data)
    print(f"{found.car.sum()} cars, {(~found.car).sum()} false alarms")
    for weight in _WEIGHTS:
        print(weight, hits_before(found, weight))


if __name__ == "__main__":
    main()
