"""Put a trained head into the chip network: ``python -m research.training.letters.export``.

The file gets one more output, ``drawn``: the log odds that a candidate is drawn. All other weights
and outputs stay as they are. A former head is replaced.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import onnx
from onnx import helper, numpy_helper
from onnx.onnx_ml_pb2 import TensorProto

from research.training.letters.features import features_name
from vehanchor.storage.atomic import whole_file

_OUTPUT = "drawn"
HEAD_PREFIX = "drawn_head"
"""Prefix of the names of the head's weights in the file."""


def with_head(model: onnx.ModelProto, head: dict[str, np.ndarray], offset: float) -> None:
    """Add the head to a chip network, in place.

    Args:
        model: the chip network.
        head: weights of ``research.training.letters.train``.
        offset: addition to the log odds: of the share of drawn things in use over that in training.
    """
    graph = model.graph
    _remove(graph)
    weight = numpy_helper.from_array(
        head["hidden_weight"].astype(np.float16), f"{HEAD_PREFIX}.hidden.half"
    )
    arrays = {
        f"{HEAD_PREFIX}.hidden_bias": head["hidden_bias"],
        f"{HEAD_PREFIX}.out": head["out_weight"],
        f"{HEAD_PREFIX}.out_bias": head["out_bias"] + np.float32(offset),
        f"{HEAD_PREFIX}.axis": np.array([1], np.int64),
    }
    constants = [weight, *(numpy_helper.from_array(array, name) for name, array in arrays.items())]
    graph.initializer.extend(constants)
    names = [f"{HEAD_PREFIX}.{part}" for part in ("hidden_float", "dense", "active", "column")]
    hidden, dense, active, column = names
    nodes = [
        helper.make_node("Cast", [weight.name], [hidden], to=TensorProto.FLOAT),
        helper.make_node(
            "Gemm", [features_name(model), hidden, f"{HEAD_PREFIX}.hidden_bias"], [dense], transB=1
        ),
        helper.make_node("Relu", [dense], [active]),
        helper.make_node(
            "Gemm", [active, f"{HEAD_PREFIX}.out", f"{HEAD_PREFIX}.out_bias"], [column], transB=1
        ),
        helper.make_node("Squeeze", [column, f"{HEAD_PREFIX}.axis"], [_OUTPUT]),
    ]
    for node, kind in zip(nodes, ("cast", "hidden", "active", "out", "squeeze"), strict=True):
        node.name = f"{HEAD_PREFIX}/{kind}"
    graph.node.extend(nodes)
    graph.output.append(helper.make_tensor_value_info(_OUTPUT, TensorProto.FLOAT, ["n"]))
    onnx.checker.check_model(model)


def _remove(graph: onnx.GraphProto) -> None:
    """Remove a former head."""
    for items in (graph.node, graph.initializer):
        for item in [item for item in items if item.name.startswith(HEAD_PREFIX)]:
            items.remove(item)
    for output in [output for output in graph.output if output.name == _OUTPUT]:
        graph.output.remove(output)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("network", type=Path)
    parser.add_argument("head", type=Path)
    parser.add_argument("--offset", type=float, default=0.0)
    options = parser.parse_args()
    model = onnx.load(options.network)
    with np.load(options.head) as table:
        with_head(model, dict(table), options.offset)
    with whole_file(options.network) as partial:
        onnx.save(model, partial)


if __name__ == "__main__":
    main()
