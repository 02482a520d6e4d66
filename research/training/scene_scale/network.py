"""From a tile of 160 px to a distribution over log metres per pixel.

The body is the encoder of the detector (``research/training/detector/network.py``), fewer blocks of
it. Training begins with the encoder's weights: what the detector has learned to tell from cars also
shows how big a pixel is.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import onnx
import torch
from onnx import numpy_helper
from torch import Tensor, nn
from torch.nn import functional

from research.training.layers import Residual, conv_block
from research.training.scene_scale.bins import BINS
from research.training.warm_start import load_exported

if TYPE_CHECKING:
    from pathlib import Path

# Channels at strides 2, 4, 8, 16, 32.
_CHANNELS = (16, 32, 64, 128, 192)
# Inner width of the residual blocks at strides 4 to 16.
_BOTTLENECK = (32, 64, 96)
_BLOCKS = (1, 1, 2, 0)
_HIDDEN = 64


class SceneScaleNet(nn.Module):
    """Five stride-2 stages; input ``[n, 3, 160, 160]`` RGB in 0..1.

    The head sees the mean and the spread of every stage from stride 4 on, which is texture, and
    what attention picks out of the last one, which is things.
    """

    def __init__(self, bins: int = BINS) -> None:
        super().__init__()
        self.stem = conv_block(3, _CHANNELS[0], stride=2)
        self.stages = nn.ModuleList(
            nn.Sequential(
                conv_block(_CHANNELS[k], _CHANNELS[k + 1], stride=2),
                *(Residual(_CHANNELS[k + 1], _BOTTLENECK[k]) for _ in range(blocks)),
            )
            for k, blocks in enumerate(_BLOCKS)
        )
        self.look = nn.Conv2d(_CHANNELS[-1], 1, 1)
        width = 2 * sum(_CHANNELS[1:]) + _CHANNELS[-1]
        self.head = nn.Sequential(
            nn.BatchNorm1d(width),
            nn.Dropout(0.1),
            nn.Linear(width, _HIDDEN),
            nn.ReLU(inplace=True),
            nn.Linear(_HIDDEN, bins),
        )

    def forward(self, tiles: Tensor) -> Tensor:
        """Compute log-probabilities ``[n, bins]``."""
        seen = self.stem(tiles)
        pooled = []
        for stage in self.stages:
            seen = stage(seen)  # [n, c, 5, 5] in the end
            mean = seen.mean(dim=(2, 3))
            square = (seen * seen).mean(dim=(2, 3))
            pooled += [mean, (square - mean * mean).clamp(min=1e-6).sqrt()]
        attention = self.look(seen).flatten(2).softmax(2)
        pooled.append((seen.flatten(2) * attention).sum(2))
        return functional.log_softmax(self.head(torch.cat(pooled, dim=1)), dim=1)

    def freeze(self, parts: int) -> None:
        """Freeze the weights of the first parts: the stem, and then one stage after another."""
        for part in (self.stem, *self.stages)[:parts]:
            part.requires_grad_(False)


def begin_with_exported(network: SceneScaleNet, path: Path, tiles: Tensor) -> None:
    """Put the weights of an exported file into ``network``.

    Args:
        network: of ``BINS`` bins.
        path: ONNX file of ``research.training.scene_scale.export``.
        tiles: ``[n, 3, 160, 160]`` float in 0..1, to take the normalisations' statistics from.
    """
    load_exported(network, path, tiles)
    stored = {
        item.name: torch.tensor(numpy_helper.to_array(item))
        for item in onnx.load(path).graph.initializer
    }
    norm = {name.rpartition(".")[2]: value for name, value in stored.items() if ".head.0." in name}
    network.load_state_dict(
        network.state_dict() | {f"head.0.{name}": value for name, value in norm.items()}
    )
