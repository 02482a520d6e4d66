"""Network that proposes courts in a coarse view, on cells of 8 px."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

CELL_PX = 8
# Log odds of tennis and of basketball, cos and sin of twice the angle, log of length over 44 px.
CHANNELS = 5
LENGTH_PX = 44.0
_STEM = ((3, 8), (8, 16), (16, 24))
_DILATIONS = (1, 2, 4, 1)
# Log odds of a court in a cell before training.
_RARE = -4.0


def _convolution(inputs: int, outputs: int, stride: int, dilation: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, dilation, dilation, bias=False),
        nn.BatchNorm2d(outputs),
        nn.ReLU(),
    )


class CourtNet(nn.Module):
    """Network of three strided and four dilated convolutions.

    Maps ``[n, 3, h, w]`` in 0..1 to ``[n, 5, h / 8, w / 8]``.
    """

    def __init__(self) -> None:
        super().__init__()
        width = _STEM[-1][1]
        self.stem = nn.Sequential(
            *(_convolution(inputs, outputs, stride=2, dilation=1) for inputs, outputs in _STEM)
        )
        self.body = nn.ModuleList(
            _convolution(width, width, stride=1, dilation=dilation) for dilation in _DILATIONS
        )
        self.head = nn.Conv2d(width, CHANNELS, 1)
        with torch.no_grad():
            cast("Tensor", self.head.bias)[:2] = _RARE

    def forward(self, pixels: Tensor) -> Tensor:
        """Compute the outputs of each cell."""
        seen = self.stem(pixels - 0.4)
        for layer in self.body:
            seen = seen + layer(seen)
        return cast("Tensor", self.head(seen))
