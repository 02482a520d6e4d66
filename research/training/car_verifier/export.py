"""Write a trained car verifier as ONNX.

``python -m research.training.car_verifier.export R OUT.onnx --weights R/main`` writes the fusion with the search's
scores as metadata, as the library reads it (``CarVerifierCard``). The fusion is fitted on the held-out tenth of ``R``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from research.training.car_verifier.network import CarVerifierNet
from research.training.car_verifier.store import read_store
from research.training.car_verifier.stream import Move, cut
from research.training.car_verifier.train import export
from research.training.loop import load_average
from research.training.onnx_file import LICENCE, write_metadata
from vehanchor.models.zoo import DEFAULT_DETECTOR

_LEAST_SCORE = 0.15  # of the search
_LEAST_COMBINED = 0.1  # of the search's scores with the bundled verifier


def logit(scores: NDArray[np.float64]) -> NDArray[np.float64]:
    """Log odds of scores, away from 0 and 1."""
    inside = np.clip(scores, 1e-4, 1 - 1e-4)
    return np.asarray(np.log(inside / (1 - inside)))


class Fusion(NamedTuple):
    """Log odds of a car: ``today * logit(score) + new * logit + bias``."""

    today: float
    new: float
    bias: float


def fitted_fusion(run: Path, network: CarVerifierNet, without: Sequence[str] = ()) -> Fusion:
    """Fit by logistic regression on the candidates of the held-out tenth, each set by the root of its number.

    Args:
        run: folder of the store ``held_out``.
        network: car verifier.
        without: sets that are left out.
    """
    chips, rows = read_store(run / "held_out")
    sure = (rows.combined >= _LEAST_COMBINED) & ((rows.box_weight > 0) | (rows.car == 0))
    chosen = np.flatnonzero(sure & ~np.isin(rows.sets, list(without)))
    still = Move(np.zeros(2), 1.0, 0.0, np.ones(2))
    new = np.zeros(len(chosen))
    with torch.no_grad():
        for start in range(0, len(chosen), 128):
            some = chosen[start : start + 128]
            batch = np.stack([cut(np.asarray(chips[k]), still) for k in some]).transpose(0, 3, 1, 2)
            said = network.eval()(torch.from_numpy(np.ascontiguousarray(batch)).float().div(255.0))
            new[start : start + 128] = said.logit.numpy()
    design = np.column_stack([logit(rows.combined[chosen].astype(np.float64)), new, np.ones(len(chosen))])
    car = rows.car[chosen] == 1
    names, number, counts = np.unique(rows.sets[chosen], return_inverse=True, return_counts=True)
    weight = (1 / np.sqrt(counts))[number]
    theta = np.array([0.5, 0.5, 0.0])
    for _ in range(30):
        chance = 1 / (1 + np.exp(-design @ theta))
        slope = design.T @ (weight * (chance - car)) + 1e-3 * theta
        bend = (design * (weight * chance * (1 - chance))[:, None]).T @ design + 1e-3 * np.eye(3)
        theta = theta - np.linalg.solve(bend, slope)
    print(f"held-out tenth: {car.sum()} cars, {(~car).sum()} others of {len(names)} sets, fusion {theta.round(3)}")
    return Fusion(*(float(value) for value in theta))


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--weights", type=Path, required=True, help="folder of a checkpoint")
    parser.add_argument("--without", default="", help="sets that the fusion leaves out, comma between")
    options = parser.parse_args()
    torch.set_num_threads(1)
    network = CarVerifierNet()
    load_average(network, options.weights)
    network.eval()
    fusion = fitted_fusion(options.run, network, options.without.split(","))
    export(network, options.out)
    metadata = {
        "description": "VehAnchor network that verifies candidates where a photograph shows few",
        "author": "VehAnchor",
        "license": LICENCE,
        "vehanchor.detector": DEFAULT_DETECTOR,
        "vehanchor.least_score": str(_LEAST_SCORE),
        "vehanchor.weights": ",".join(f"{value:.4f}" for value in fusion),
    }
    write_metadata(options.out, metadata)
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.2f} MB, {metadata['vehanchor.weights']}")


if __name__ == "__main__":
    main()
