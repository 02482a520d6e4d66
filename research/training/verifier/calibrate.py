"""Fit the clear score with a verifier.

``python -m research.training.verifier.calibrate``, for ``combine --clear-score``.

As in ``research.training.detector.calibrate``: the score that the clearest tenth of the cars reaches in 98 of 100
images of *train* with many cars. The detector is the bundled one with its verifier, or ``--detector FILE`` with the
one beside it. The scene-scale prior is left out: where it was never shown the like it takes 1.2 of its weight from
every score, and cars there shall not be doubted for that. Also prints what the verifier's scores give for a few cars
drawn at random from an image, on which ``vehanchor.rulers.confidence`` stands.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from research.training.detector.calibrate import clear_score
from vehanchor import analyse_scale
from vehanchor.detection.detector import Detector
from vehanchor.detection.verifier import Weights
from vehanchor.models.zoo import resolve_model
from vehanchor.options import ScaleOptions
from vehanchor_evaluation.table import read_table

_MANY_CARS = 20
_FEW = (5, 8, 12, 20)
_DRAWS = 20
_LOST_GROUND = -1.2  # log odds that it gives every size


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--detector")
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    options = parser.parse_args()
    detector = Detector(resolve_model(options.detector))
    vehicles_alone = ScaleOptions.of({"rulers": ["vehicles"]})
    analyses = [
        analyse_scale(item.path, vehicles_alone, detector=detector)
        for item in read_table(options.data / "gsd" / "table.csv")
        if item.split == "train" and (item.labelled_vehicles or 0) >= _MANY_CARS
    ]
    clear = clear_score(analyses)
    print(f"{clear - 0.005:.2f} by vehicles alone, from {len(analyses)} images")
    verifier = detector.verifier
    size = Weights(*verifier.card.weights).size if verifier else 0.0
    lost = Weights(1.0, 0.0, 0.0, size).score(clear, 0.0, _LOST_GROUND)
    print(f"{lost - 0.005:.2f} where the ground is lost: the clear score")
    scores = [some for each in analyses if len(some := each.detections.scores) >= _MANY_CARS]
    for few in _FEW:
        drawn = np.random.default_rng(0)
        clearest = [np.percentile(drawn.choice(some, few, replace=False), 90) for some in scores for _ in range(_DRAWS)]
        print(f"{np.percentile(clearest, 2):.3f} of {few} cars drawn from one image")


if __name__ == "__main__":
    main()
