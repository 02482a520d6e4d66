"""Write a trained car verifier as ONNX.

``python -m research.training.car_verifier.export R OUT.onnx --weights R/main`` writes the fusion with the search's
scores as metadata. The fusion is fitted on the held-out tenth of ``R``.
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


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--weights", type=Path, required=True, help="folder of a checkpoint")
    options = parser.parse_args()
    torch.set_num_threads(1)
    network = CarVerifierNet()
    load_average(network, options.weights)
    network.eval()
    fusion = fitted_fusion(options.run, network)
    export(network, options.out)
    metadata = {
        "description": "VehAnchor network that verifies candidates where a photograph shows few",
        "author": "VehAnchor",
        "license": LICENCE,
        "vehanchor.fusion": ",".join(f"{value:.4f}" for value in fusion),
    }
    write_metadata(options.out, metadata)
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.2f} MB, {metadata['vehanchor.fusion']}")


if __name__ == "__main__":
    main()
