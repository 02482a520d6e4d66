"""Write the chip network as ONNX: ``python -m research.training.chips.export RUN OUT.onnx``.

Large weights are stored in half precision and cast when the file is opened: it takes half the
space, and the network computes in float32 as before.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn

from research.training.chips.network import Answers, ChipNet
from research.training.loop import load_average
from research.training.onnx_file import LICENCE, write_metadata, write_onnx
from vehanchor.detection.chips import CHIP_COLUMNS, CHIP_ROWS
from vehanchor.models.zoo import DEFAULT_DETECTOR
from vehanchor.storage.atomic import whole_file

# Larger arrays are stored in half precision.
_LARGE = 256
# Least score of the search.
_MIN_SCORE = 0.15
# Regions: medians over train images of known scale of the bodies' median length, of vehicles with a
# score above 0.6 and
# 3 to 6.5 m, five or more in an image: Cannes, Sao Paulo, US cities, Estonia, Banepa. The reference
# is their median.
# Its standard deviation is a choice: theirs is 0.37 m.
_BODIES = {
    "reference_length_m": 4.21,
    "reference_length_sd_m": 0.36,
    "region_lengths_m": {
        "europe": 3.95, "south_america": 4.21, "north_america": 4.69, "northern_europe": 4.52,
        "south_asia": 3.68,
    },
}  # fmt: skip
# Factor on the stated spreads, measured on held-back readings: training includes blur and shade.
_EDGE_SD = 0.7


class Exported(nn.Module):
    """The network with its answers as the file has them."""

    def __init__(self, network: ChipNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, chips: Tensor) -> tuple[Tensor, ...]:
        """Compute all answers."""
        said: Answers = self.network(chips)
        return tuple(said._replace(edge_log_sd=said.edge_log_sd + math.log(_EDGE_SD)))


def export(network: ChipNet, out: Path) -> None:
    """Write a network: ``chips [n, 3, 64, 96]`` to the answers."""
    example = torch.zeros(2, 3, CHIP_ROWS, CHIP_COLUMNS)
    names = list(Answers._fields)
    write_onnx(
        Exported(network),
        (example,),
        out=out,
        inputs=["chips"],
        outputs=names,
        free={name: {0: "n"} for name in ("chips", *names)},
    )
    _halve(out)
    write_weights(out, (1.0, 1.0, 0.0))


def write_weights(path: Path, weights: tuple[float, float, float]) -> None:
    """Write the metadata of a file: weights of the logits of search and network, and their bias."""
    metadata = {
        "description": "VehAnchor network that says of a candidate what it is, where its edges "
        "lie, and how long it is",
        "author": "VehAnchor",
        "license": LICENCE,
        "vehanchor.detector": DEFAULT_DETECTOR,
        "vehanchor.weights": ",".join(f"{value:.4f}" for value in weights),
        "vehanchor.least_score": f"{_MIN_SCORE:g}",
        "vehanchor.bodies": json.dumps(_BODIES),
    }
    write_metadata(path, metadata)


def _halve(path: Path) -> None:
    """Store the large weights of a file in half precision."""
    model = onnx.load(path)
    casts = []
    for stored in model.graph.initializer:
        values = numpy_helper.to_array(stored)
        if values.dtype == np.float32 and values.size > _LARGE:
            name = stored.name
            stored.CopyFrom(numpy_helper.from_array(values.astype(np.float16), f"{name}.half"))
            casts.append(
                onnx.helper.make_node("Cast", [f"{name}.half"], [name], to=onnx.TensorProto.FLOAT)
            )
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    onnx.checker.check_model(model)
    with whole_file(path) as partial:
        onnx.save(model, partial)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    options = parser.parse_args()
    network = ChipNet()
    load_average(network, options.run)
    export(network, options.out)
    print(f"{options.out}: {options.out.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
