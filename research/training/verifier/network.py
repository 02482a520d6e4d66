"""Network from a candidate's chip to the logit of a car."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from research.training.layers import conv_block

# Inputs, outputs and stride of each convolution.
_LAYERS = ((3, 32, 2), (32, 40, 1), (40, 64, 2), (64, 88, 1), (88, 112, 2), (112, 112, 1))


class VerifierNet(nn.Module):
    """Network of six 3 x 3 convolutions; input ``[b, 3, 48, 48]`` in 0..1.

    The middle of the chip and its mean enter the last layer side by side.
    """

    def __init__(self) -> None:
        super().__init__()
        self.body = nn.Sequential(
            *(conv_block(inputs, outputs, stride=stride) for inputs, outputs, stride in _LAYERS)
        )
        width = _LAYERS[-1][1]
        self.head = nn.Sequential(
            nn.Linear(2 * width, 48), nn.ReLU(inplace=True), nn.Dropout(0.2), nn.Linear(48, 1)
        )

    def forward(self, chips: Tensor) -> Tensor:
        """Compute logits ``[b]``."""
        seen = self.body(chips)  # [b, c, 6, 6]
        middle = seen[:, :, 2:4, 1:5].mean(dim=(2, 3))
        whole = seen.mean(dim=(2, 3))
        return cast("Tensor", self.head(torch.cat([middle, whole], dim=1))).squeeze(1)
