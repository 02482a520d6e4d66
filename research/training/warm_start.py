"""Continue from an exported network: its folded weights back into a trainable network.

The ONNX file has every batch normalisation folded into the convolution before it. Here each one
gets the statistics of real crops, and a scale and shift that undo them, so that the network
computes what the file computes and its normalisations work again.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn

if TYPE_CHECKING:
    from pathlib import Path


def load_exported(
    network: nn.Module, path: Path, *inputs: object, without: tuple[str, ...] = ()
) -> None:
    """Put the weights of an exported file into ``network``.

    Args:
        network: of the architecture that was exported.
        path: the ONNX file.
        inputs: what the network is called with; training crops to take the statistics from.
        without: prefixes of the names of weights that were put into the file later, and that the
            network lacks.

    Raises:
        ValueError: the file's convolutions and linear layers are not this network's.
    """
    graph = onnx.load(path).graph
    values = {item.name: torch.tensor(numpy_helper.to_array(item)) for item in graph.initializer}
    for node in graph.node:  # weights that are equal are kept once; half precision is cast
        if node.op_type in ("Identity", "Cast") and node.input[0] in values:
            values[node.output[0]] = values[node.input[0]].float()
    learnt = [
        node
        for node in graph.node
        if node.op_type in ("Conv", "Gemm")
        and node.input[1] in values
        and not node.input[1].startswith(without)
    ]
    # A fixed blur is not an initializer.
    stored = [[values[name] for name in node.input[1:]] for node in learnt]
    order: list[nn.Conv2d | nn.Linear] = []  # as the export traced them
    hooks = [
        module.register_forward_hook(lambda module, _inputs, _output: order.append(module))
        for module in network.modules()
        if isinstance(module, nn.Conv2d | nn.Linear)
    ]
    with torch.no_grad():
        network.eval()(*inputs)
    for hook in hooks:
        hook.remove()
    if [tuple(conv.weight.shape) for conv in order] != [
        tuple(weight.shape) for weight, _ in stored
    ]:
        raise ValueError(
            f"{path}: its convolutions are not those of this network; was it exported from "
            "another one?"
        )
    shift = {}
    for conv, (weight, bias) in zip(order, stored, strict=True):
        conv.weight.data.copy_(weight)
        if conv.bias is not None:
            conv.bias.data.copy_(bias)
        shift[conv] = bias

    def undo(norm: nn.BatchNorm2d, bias: Tensor) -> None:
        def measure(_module: nn.Module, inputs: tuple[Tensor, ...]) -> None:
            (raw,) = inputs
            mean = raw.mean(dim=(0, 2, 3))
            variance = raw.var(dim=(0, 2, 3), unbiased=False)
            assert norm.running_mean is not None
            assert norm.running_var is not None
            norm.running_mean.copy_(mean)
            norm.running_var.copy_(variance)
            norm.weight.data.copy_((variance + norm.eps).sqrt())
            norm.bias.data.copy_(mean + bias)

        hooks.append(norm.register_forward_pre_hook(measure))

    hooks.clear()
    for block in network.modules():
        if isinstance(block, nn.Sequential):
            for before, norm in pairwise(block):
                if isinstance(before, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                    undo(norm, shift[before])
    with torch.no_grad():
        network(*inputs)  # one pass: each normalisation is set just before it is used
    for hook in hooks:
        hook.remove()
