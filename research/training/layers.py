"""Blocks that the networks share."""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional


def conv_block(
    inputs: int, outputs: int, kernel: int = 3, stride: int = 1, dilation: int = 1
) -> nn.Sequential:
    """Make a convolution with batch normalisation and ReLU; at stride 1 the size stays."""
    return nn.Sequential(
        nn.Conv2d(
            inputs, outputs, kernel, stride, dilation * (kernel // 2), dilation=dilation, bias=False
        ),
        nn.BatchNorm2d(outputs),
        nn.ReLU(inplace=True),
    )


class Residual(nn.Module):
    """Bottleneck of two 3 x 3 convolutions, added to its input ``[b, channels, h, w]``."""

    def __init__(self, channels: int, inner: int, dilation: int = 1) -> None:
        super().__init__()
        self.enter = conv_block(channels, inner, dilation=dilation)
        self.leave = nn.Sequential(
            nn.Conv2d(inner, channels, 3, 1, 1, bias=False), nn.BatchNorm2d(channels)
        )

    def forward(self, x: Tensor) -> Tensor:
        """Add what the block computes."""
        return functional.relu(x + self.leave(self.enter(x)))
