"""Slow models: a run takes seconds, in layers of milliseconds each, and can be stopped."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import helper, numpy_helper

_LAYERS = 800
_CHANNELS = 16
_SIDE_PX = 256


def weighed_down(source: Path, target: Path) -> Path:
    """Write a copy of a model that first runs hundreds of convolutions, with the same outputs.

    Args:
        source: an ONNX file.
        target: of the copy.
    """
    model = onnx.load(str(source))
    graph = model.graph
    constants: dict[str, NDArray[Any]] = {
        "slow/shape": np.array([1, _CHANNELS, _SIDE_PX, _SIDE_PX], np.int64),
        # no value fades away
        "slow/mean": np.full((_CHANNELS, _CHANNELS, 3, 3), 1 / (9 * _CHANNELS), np.float32),
        "slow/zero": np.zeros(1, np.float32),
    }
    graph.initializer.extend(
        numpy_helper.from_array(value, name) for name, value in constants.items()
    )
    nodes = [
        helper.make_node("ReduceMean", [graph.input[0].name], ["slow/level"], keepdims=0),
        helper.make_node("Expand", ["slow/level", "slow/shape"], ["slow/0"]),
    ]
    for i in range(_LAYERS):
        nodes.append(
            helper.make_node(
                "Conv",
                [f"slow/{i}", "slow/mean"],
                [f"slow/{i + 1}"],
                pads=[1] * 4,
                kernel_shape=[3, 3],
            )
        )
    nodes.append(helper.make_node("ReduceMean", [f"slow/{_LAYERS}"], ["slow/end"], keepdims=0))
    nodes.append(helper.make_node("Mul", ["slow/end", "slow/zero"], ["slow/nothing"]))
    output = graph.output[0].name
    for node in graph.node:
        node.output[:] = [f"{name}/light" if name == output else name for name in node.output]
    nodes += [*graph.node, helper.make_node("Add", [f"{output}/light", "slow/nothing"], [output])]
    del graph.node[:]
    graph.node.extend(nodes)
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, str(target))
    return target
