"""From a vehicle's chip to the log odds that it is of North America's fleet, and to the log of its length in metres."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, cast

import torch
from torch import Tensor, nn

from research.training.layers import conv_block

if TYPE_CHECKING:
    from collections.abc import Sequence

_LAYERS = ((1, 24, 1), (24, 32, 2), (32, 48, 1), (48, 64, 2), (64, 64, 1))  # inputs, outputs, stride
_MIDDLE_LOG_M, _SPREAD_LOG_M = math.log(4.55), 0.1  # about those of cars of all fleets


class FleetNet(nn.Module):
    """Five 3 x 3 convolutions and a mean over the chip; input ``[b, 1, 16, 24]``, outputs ``[b]`` each."""

    def __init__(self) -> None:
        super().__init__()
        self.body = nn.Sequential(*(conv_block(inputs, outputs, stride=stride) for inputs, outputs, stride in _LAYERS))
        self.head = nn.Sequential(nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Dropout(0.3), nn.Linear(_LAYERS[-1][1], 2))

    def forward(self, chips: Tensor) -> tuple[Tensor, Tensor]:
        """Log odds, and log lengths."""
        odds, length = cast("Tensor", self.head(self.body(chips))).unbind(dim=1)
        return odds, _MIDDLE_LOG_M + _SPREAD_LOG_M * length


class Mean(nn.Module):
    """The mean of some networks' answers to a chip and to the chip turned by half: cars are alike from both ends."""

    def __init__(self, networks: Sequence[FleetNet]) -> None:
        super().__init__()
        self.networks = nn.ModuleList(networks)

    def forward(self, chips: Tensor) -> tuple[Tensor, Tensor]:
        """Log odds, and log lengths."""
        views = [network(view) for network in self.networks for view in (chips, chips.flip(2, 3))]
        odds, lengths = (torch.stack(answers).mean(dim=0) for answers in zip(*views, strict=True))
        return odds, lengths
