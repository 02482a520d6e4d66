"""Write the verifier in eight bits.

``python -m research.training.verifier.quantise RUN MODEL.onnx OUT.onnx``.

Its convolutions get eight bits, the two layers at its end stay; activations by chips of ``RUN``'s
training part.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from research.training.eight_bits import write_eight_bits
from research.training.verifier.data import load, middle

if TYPE_CHECKING:
    import onnx

_CHIPS = 1024
_BATCH = 64


def quantised_nodes(model: onnx.ModelProto) -> list[str]:
    """List the nodes that get eight bits."""
    return [node.name for node in model.graph.node if node.op_type in ("Conv", "Relu")]


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("model", type=Path)
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    candidates = load(arguments.run / "train.npz")
    rng = np.random.default_rng(0)
    sample = np.sort(
        rng.choice(
            len(candidates.car), min(_CHIPS, len(candidates.car)) // _BATCH * _BATCH, replace=False
        )
    )
    chips = (
        np.ascontiguousarray(middle(candidates.chips)[sample].transpose(0, 3, 1, 2)).astype(
            np.float32
        )
        / 255
    )
    batches = [chips[start : start + _BATCH] for start in range(0, len(chips), _BATCH)]
    write_eight_bits(
        arguments.model, arguments.out, batches=batches, nodes=quantised_nodes, metadata={}
    )
    print(f"{arguments.out}: {arguments.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
