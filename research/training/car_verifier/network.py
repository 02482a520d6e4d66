"""The car verifier: from a candidate's chip to car or not, vehicle type, box correction and length in metres."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from research.training.detector.network import VehicleNet

_MIDDLE = {1: (16, 2, 10), 2: (24, 1, 5), 3: (32, 0, 3)}  # stage: channels kept, first and last cell of the middle
_HIDDEN = 128


class Answers(NamedTuple):
    """Outputs for a batch of chips.

    Attributes:
        logit: ``[b]`` of a car in a fitting box.
        types: ``[b, 10]`` logits of ``VEHICLE_TYPES``.
        box: ``[b, 5]`` correction: centre along and across, in candidate lengths; log of the true length and width over
            the candidate's length; turn in radians.
        log_length_m: ``[b]`` log of the vehicle's length in metres.
    """

    logit: Tensor
    types: Tensor
    box: Tensor
    log_length_m: Tensor


class CarVerifierNet(nn.Module):
    """The detector's encoder and a head of its own; 1.9 M parameters, 0.06 G multiplications a chip.

    The head sees the middle of the chip at strides 8, 16 and 32, every cell in its place since the box correction needs
    to know where things are, and the means over the whole chip. Input ``[b, 3, 96, 96]`` RGB in 0..1.
    """

    def __init__(self) -> None:
        super().__init__()
        detector = VehicleNet()
        self.stem, self.stages = detector.stem, detector.stages
        widths = {k: self._width(stage) for k, stage in enumerate(self.stages)}
        self.middles = nn.ModuleDict(
            {
                str(k): nn.Sequential(
                    nn.Conv2d(widths[k], kept, 1, bias=False), nn.BatchNorm2d(kept), nn.ReLU(inplace=True)
                )
                for k, (kept, _, _) in _MIDDLE.items()
            }
        )
        inputs = sum(kept * (last - first) ** 2 + widths[k] for k, (kept, first, last) in _MIDDLE.items())
        self.head = nn.Sequential(
            nn.Linear(inputs, _HIDDEN), nn.ReLU(inplace=True), nn.Dropout(0.2), nn.Linear(_HIDDEN, 17)
        )

    @staticmethod
    def _width(stage: nn.Module) -> int:
        first = next(module for module in stage.modules() if isinstance(module, nn.Conv2d))
        return first.out_channels

    def forward(self, chips: Tensor) -> Answers:
        """Answers for chips ``[b, 3, 96, 96]``."""
        seen, parts = self.stem(chips), []
        for k, stage in enumerate(self.stages):
            seen = stage(seen)
            if k in _MIDDLE:
                _, first, last = _MIDDLE[k]
                middle = self.middles[str(k)](seen[:, :, first:last, first:last])
                parts += [middle.flatten(1), seen.mean(dim=(2, 3))]
        out = self.head(torch.cat(parts, dim=1))
        return Answers(out[:, 0], out[:, 1:11], out[:, 11:16], out[:, 16] + 1.5)
