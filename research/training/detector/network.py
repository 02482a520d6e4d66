"""Compact one-class oriented-box network: heat, offset, log length, log width, double angle.

Encoder to stride 32 for context, decoder back to stride 4 for localisation; plain 3 x 3
convolutions with batch normalisation and ReLU, which ONNX Runtime fuses on a CPU.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from research.training.layers import Residual, conv_block
from research.training.warm_start import load_exported

if TYPE_CHECKING:
    from pathlib import Path

STRIDE_PX = 4
# Channels at strides 2, 4, 8, 16, 32.
_CHANNELS = (16, 32, 64, 128, 192)
# Inner width of the residual blocks at strides 4 to 32.
_BOTTLENECK = (32, 64, 96, 96)
_BLOCKS = (1, 2, 2, 2)
_DECODER = (96, 64, 32)


class Prediction(NamedTuple):
    """Dense output at stride 4.

    Attributes:
        heat: ``[b, 1, h, w]`` logits of "a vehicle's centre is in this cell".
        shape: ``[b, 6, h, w]`` offset x, offset y (cells), log length, log width (log px), cos 2t,
            sin 2t.
    """

    heat: Tensor
    shape: Tensor


class VehicleNet(nn.Module):
    """The detector network; input ``[b, 3, h, w]`` RGB in 0..1, sides divisible by 32."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = conv_block(3, _CHANNELS[0], stride=2)
        self.stages = nn.ModuleList(
            nn.Sequential(
                conv_block(_CHANNELS[k], _CHANNELS[k + 1], stride=2),
                *(Residual(_CHANNELS[k + 1], _BOTTLENECK[k]) for _ in range(_BLOCKS[k])),
            )
            for k in range(4)
        )
        wide, middle, narrow = _DECODER
        self.laterals = nn.ModuleList(
            conv_block(inputs, outputs, kernel=1)
            for inputs, outputs in zip(_CHANNELS[:0:-1], (wide, wide, middle, narrow), strict=True)
        )
        self.merges = nn.ModuleList(
            [conv_block(wide, middle), conv_block(middle, narrow), conv_block(narrow, narrow)]
        )
        self.heat_head = nn.Sequential(conv_block(narrow, 32), nn.Conv2d(32, 1, 1))
        self.shape_head = nn.Sequential(conv_block(narrow, 32), nn.Conv2d(32, 6, 1))
        heat_out = self.heat_head[-1]
        shape_out = self.shape_head[-1]
        assert isinstance(heat_out, nn.Conv2d)
        assert isinstance(shape_out, nn.Conv2d)
        assert heat_out.bias is not None
        assert shape_out.bias is not None
        # A cell holds a centre about once in a hundred, so training starts there.
        nn.init.constant_(heat_out.bias, -4.6)
        with torch.no_grad():
            # Boxes start at exp(3.2) = 25 px by 10 px.
            shape_out.bias.copy_(torch.tensor([0.0, 0.0, 3.2, 2.3, 0.0, 0.0]))

    def forward(self, image: Tensor) -> Prediction:
        """Predict heat and shape at stride 4."""
        x = self.stem(image)
        levels = []
        for stage in self.stages:
            x = stage(x)
            levels.append(x)
        y = self.laterals[0](levels[3])
        for k, merge in enumerate(self.merges):
            y = merge(
                self.laterals[k + 1](levels[2 - k])
                + functional.interpolate(y, scale_factor=2.0, mode="nearest")
            )
        return Prediction(self.heat_head(y), self.shape_head(y))


def begin_with_detector(network: nn.Module, detector: Path, chips: Tensor) -> None:
    """Put the encoder of an exported detector into ``network``.

    Args:
        network: a network with the same encoder.
        detector: ONNX file of ``research.training.detector.export``.
        chips: ``[n, 3, h, w]`` float in 0..1, for the statistics of the normalisations.
    """
    whole = VehicleNet()
    load_exported(whole, detector, chips)
    mine = network.state_dict()
    network.load_state_dict(
        {**mine, **{name: v for name, v in whole.state_dict().items() if name in mine}}
    )
