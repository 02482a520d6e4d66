"""Write the chip network as ONNX."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from research.training.chips.network import CHIP_COLUMNS, CHIP_ROWS, Answers, ChipNet
from research.training.onnx_file import write_onnx

if TYPE_CHECKING:
    from pathlib import Path


class Exported(nn.Module):
    """The network with its answers as the file has them."""

    def __init__(self, network: ChipNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, chips: Tensor) -> tuple[Tensor, ...]:
        """All answers."""
        return tuple(self.network(chips))


def export(network: ChipNet, out: Path) -> None:
    """Write a network: ``chips [n, 3, 64, 96]`` to the answers."""
    example = torch.zeros(2, 3, CHIP_ROWS, CHIP_COLUMNS)
    names = list(Answers._fields)
    write_onnx(Exported(network), (example,), out, ["chips"], names, {name: {0: "n"} for name in ("chips", *names)})
