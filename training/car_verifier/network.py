"""The car verifier: from a candidate's chip to car or not, vehicle type, box correction and length in metres."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

CHIP_PX = 96  # rows and columns of a chip: three candidate lengths
CHIP_LENGTH_PX = 32.0  # the candidate's length on its chip, along the columns
TYPES = ("kei", "small", "compact", "saloon", "suv", "pickup", "van", "lorry", "trailer", "other")
_STAGES = ((32, 64, 1), (64, 128, 1), (128, 192, 1))  # inputs, outputs, residual blocks
_HIDDEN = 128


class Answers(NamedTuple):
    """Outputs for a batch of chips.

    Attributes:
        logit: ``[b]`` of a car in a fitting box.
        types: ``[b, 10]`` logits of ``TYPES``.
        box: ``[b, 5]`` correction: centre along and across, in candidate lengths; log of the true length and width over
            the candidate's length; turn in radians.
        log_length_m: ``[b]`` log of the vehicle's length in metres.
    """

    logit: Tensor
    types: Tensor
    box: Tensor
    log_length_m: Tensor


def _conv(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm2d(outputs), nn.ReLU(inplace=True)
    )


class _Residual(nn.Module):
    """Two 3 x 3 convolutions beside an identity."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = _conv(width, width)
        self.second = nn.Sequential(nn.Conv2d(width, width, 3, 1, 1, bias=False), nn.BatchNorm2d(width))

    def forward(self, x: Tensor) -> Tensor:
        """Same shape as the input."""
        return torch.relu(x + self.second(self.first(x)))


class CarVerifierNet(nn.Module):
    """1.5 M parameters, 0.14 G multiplications a chip; input ``[b, 3, 96, 96]`` in 0..1."""

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = [_conv(3, 32, 2)]
        for inputs, outputs, blocks in _STAGES:
            layers.append(_conv(inputs, outputs, 2))
            layers.extend(_Residual(outputs) for _ in range(blocks))
        self.body = nn.Sequential(*layers)
        width = _STAGES[-1][1]
        # The middle 4 x 4 of 6 x 6 cells keep their places: the box correction needs to know where things are.
        self.centre = nn.Sequential(nn.Conv2d(width, 24, 1, bias=False), nn.BatchNorm2d(24), nn.ReLU(inplace=True))
        self.head = nn.Sequential(
            nn.Linear(24 * 16 + 2 * width, _HIDDEN), nn.ReLU(inplace=True), nn.Dropout(0.2), nn.Linear(_HIDDEN, 17)
        )

    def forward(self, chips: Tensor) -> Answers:
        """Answers for chips ``[b, 3, 96, 96]``."""
        seen = self.body(chips)  # [b, c, 6, 6]
        middle = seen[:, :, 2:4, 1:5].mean(dim=(2, 3))
        places = self.centre(seen)[:, :, 1:5, 1:5].flatten(1)
        out = self.head(torch.cat([places, middle, seen.mean(dim=(2, 3))], dim=1))
        return Answers(out[:, 0], out[:, 1:11], out[:, 11:16], out[:, 16] + 1.5)
