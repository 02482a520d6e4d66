"""Write a trained car verifier as ONNX.

``python -m research.training.car_verifier.export R OUT.onnx --weights R/main`` writes the fusion with the search's
scores as metadata, as the library reads it (``CarVerifierCard``). The fusion is fitted on the held-out tenth of ``R``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from research.training.car_verifier.measure import fitted_fusion
from research.training.car_verifier.network import CarVerifierNet
from research.training.car_verifier.train import export
from research.training.loop import load_average
from research.training.onnx_file import LICENCE, write_metadata
from vehanchor.models.zoo import DEFAULT_DETECTOR

_LEAST_SCORE = 0.15  # of the search, as in ``measured.json``


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
