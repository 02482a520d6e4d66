"""Compact promptable segmenter: encoder with a stride-2 embedding, prompt-conditioned decoder.

The prompt is drawn as dense maps (signed distance to the box, its own coordinates, points, an
earlier mask) at the embedding's resolution with ordinary operators, so the exported decoder takes
SAM's ``point_coords`` and ``point_labels``. Both halves are fully convolutional: any input side
divisible by 32 works.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from research.training.layers import Residual, conv_block

# Stride of the embedding and of the low-resolution mask.
STRIDE_PX = 2
EMBEDDING_CHANNELS = 24
# Channels of the encoder at strides 2, 4, 8, 16, 32.
_CHANNELS = (24, 48, 96, 160, 192)
_BOTTLENECK = (40, 64, 96, 96)
_BLOCKS = (1, 2, 2, 1)
# Channels of the encoder's way up, at strides 16, 8, 4, 2.
_UP = (96, 64, 48, EMBEDDING_CHANNELS)
# Channels of the decoder at strides 2, 4, 8, 16.
_DECODER = (24, 48, 64, 96)
_PROMPT_MAPS = 11
# Distances to the box's sides saturate here.
_NEAR_PX = 16.0
_EDGE_PX = 4.0
# Gaussian radii of a point's two maps.
_POINT_PX = (4.0, 24.0)

# SAM's labels
POSITIVE = 1.0
NEGATIVE = 0.0
TOP_LEFT = 2.0
BOTTOM_RIGHT = 3.0
PADDING = -1.0


class Prompt(NamedTuple):
    """A batch of prompts in input pixels (continuous: the first pixel spans 0 to 1).

    Attributes:
        points: ``[b, n, 2]`` x, y.
        labels: ``[b, n]`` 1 inside, 0 outside, 2 and 3 a box's corners, -1 padding.
        prior: ``[b, 1, h, w]`` logits of an earlier mask at stride 2.
        has_prior: ``[b]`` 1 where ``prior`` counts, else 0.
    """

    points: Tensor
    labels: Tensor
    prior: Tensor
    has_prior: Tensor


class Segmentation(NamedTuple):
    """Output of the decoder: ``mask`` logits ``[b, 1, h, w]`` at stride 2; ``iou`` ``[b, 1]``."""

    mask: Tensor
    iou: Tensor


def _twice(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2.0, mode="nearest")


class Encoder(nn.Module):
    """``[b, 3, s, s]`` RGB in 0..1 to the embedding ``[b, 24, s / 2, s / 2]``."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = conv_block(3, _CHANNELS[0], kernel=5, stride=2)
        self.stages = nn.ModuleList(
            nn.Sequential(
                conv_block(_CHANNELS[k], _CHANNELS[k + 1], stride=2),
                *(Residual(_CHANNELS[k + 1], _BOTTLENECK[k]) for _ in range(_BLOCKS[k])),
            )
            for k in range(4)
        )
        self.enter_up = conv_block(_CHANNELS[4], _UP[0], kernel=1)
        self.laterals = nn.ModuleList(
            conv_block(inputs, outputs, kernel=1)
            for inputs, outputs in zip(_CHANNELS[3::-1], _UP, strict=True)
        )
        self.merges = nn.ModuleList(
            conv_block(inputs, outputs)
            for inputs, outputs in zip(_UP, (*_UP[1:], EMBEDDING_CHANNELS), strict=True)
        )

    def forward(self, image: Tensor) -> Tensor:
        """Encode."""
        levels = [self.stem(image - 0.45)]
        for stage in self.stages:
            levels.append(stage(levels[-1]))
        y = self.enter_up(levels[4])
        for k, (lateral, merge) in enumerate(zip(self.laterals, self.merges, strict=True)):
            y = merge(lateral(levels[3 - k]) + _twice(y))
        out: Tensor = y
        return out


def prompt_maps(prompt: Prompt, height: int, width: int) -> Tensor:
    """Draw prompts as ``[b, 11, height, width]`` maps at the embedding's resolution.

    A box's corner maps are zero without a box, a point's without points, so one network reads every
    combination.
    """
    points = prompt.points
    labels = prompt.labels
    row_numbers = torch.arange(height, dtype=torch.float32, device=points.device)
    col_numbers = torch.arange(width, dtype=torch.float32, device=points.device)
    rows = (row_numbers.view(1, 1, -1, 1) + 0.5) * STRIDE_PX
    cols = (col_numbers.view(1, 1, 1, -1) + 0.5) * STRIDE_PX

    def corner(label: float) -> tuple[Tensor, Tensor]:
        chosen = (labels == label).to(points.dtype)
        place = (points * chosen.unsqueeze(2)).sum(dim=1)
        x, y = place.unbind(dim=1)
        return x.view(-1, 1, 1, 1), y.view(-1, 1, 1, 1)

    n_boxes = (labels == TOP_LEFT).to(points.dtype).sum(dim=1)
    has_box = n_boxes.clamp(max=1.0).view(-1, 1, 1, 1)
    # Corners change places in a mirrored image.
    (xa, ya) = corner(TOP_LEFT)
    (xb, yb) = corner(BOTTOM_RIGHT)
    (x0, y0) = (torch.minimum(xa, xb), torch.minimum(ya, yb))
    (x1, y1) = (torch.maximum(xa, xb), torch.maximum(ya, yb))
    wide = (x1 - x0).clamp(min=2.0)
    high = (y1 - y0).clamp(min=2.0)
    # -1 to 1 inside the box
    across = (2 * cols - x0 - x1) / wide
    down = (2 * rows - y0 - y1) / high
    inside_x = torch.minimum(cols - x0, x1 - cols)
    inside_y = torch.minimum(rows - y0, y1 - rows)
    inside = torch.minimum(inside_x, inside_y)
    from_centre = torch.maximum(across.abs(), down.abs())
    plane = has_box * torch.ones_like(inside)
    boxed = [
        has_box * (inside / _NEAR_PX).clamp(-1.0, 1.0),
        has_box * (1.0 - from_centre).clamp(-1.0, 1.0),
        has_box * torch.exp(-inside.abs() / _EDGE_PX),
        (has_box * across).clamp(-1.5, 1.5) * torch.ones_like(inside),
        (has_box * down).clamp(-1.5, 1.5) * torch.ones_like(inside),
        plane,
    ]

    dx = cols - points[:, :, 0].unsqueeze(2).unsqueeze(3)
    dy = rows - points[:, :, 1].unsqueeze(2).unsqueeze(3)
    squared = dx * dx + dy * dy
    dotted = []
    for label in (POSITIVE, NEGATIVE):
        chosen = (labels == label).to(points.dtype).unsqueeze(2).unsqueeze(3)
        dotted += [
            (torch.exp(squared / (-2.0 * radius * radius)) * chosen).amax(dim=1, keepdim=True)
            for radius in _POINT_PX
        ]
    prior = prompt.has_prior.view(-1, 1, 1, 1) * torch.tanh(prompt.prior / 4.0)
    return torch.cat([*boxed, *dotted, prior], dim=1)


class Decoder(nn.Module):
    """Embedding and prompt to a mask and the overlap the decoder expects it to have."""

    def __init__(self) -> None:
        super().__init__()
        two, four, eight, sixteen = _DECODER
        self.enter = conv_block(EMBEDDING_CHANNELS + _PROMPT_MAPS, two)
        self.down_four = nn.Sequential(conv_block(two, four, stride=2), Residual(four, 40))
        self.down_eight = nn.Sequential(
            conv_block(four, eight, stride=2),
            Residual(eight, eight, dilation=2),
            Residual(eight, eight),
        )
        self.down_sixteen = nn.Sequential(
            conv_block(eight, sixteen, stride=2),
            Residual(sixteen, sixteen),
            Residual(sixteen, sixteen, dilation=2),
        )
        self.up_eight = conv_block(sixteen, eight, kernel=1)
        self.merge_eight = conv_block(eight, eight)
        self.up_four = conv_block(eight, four, kernel=1)
        self.merge_four = conv_block(four, four)
        self.up_two = conv_block(four, two, kernel=1)
        self.merge_two = conv_block(two, two)
        self.mask = nn.Conv2d(two, 1, 3, 1, 1)
        self.iou = nn.Sequential(
            nn.Linear(sixteen + two + 2, 48), nn.ReLU(inplace=True), nn.Linear(48, 1)
        )
        assert self.mask.bias is not None
        nn.init.constant_(self.mask.bias, -1.5)

    def forward(self, embedding: Tensor, prompt: Prompt) -> Segmentation:
        """Decode one prompt for each embedding of the batch."""
        maps = prompt_maps(prompt, embedding.shape[2], embedding.shape[3])
        two = self.enter(torch.cat([embedding, maps], dim=1))
        four = self.down_four(two)
        eight = self.down_eight(four)
        sixteen = self.down_sixteen(eight)
        y = self.merge_eight(eight + _twice(self.up_eight(sixteen)))
        y = self.merge_four(four + _twice(self.up_four(y)))
        y = self.merge_two(two + _twice(self.up_two(y)))
        mask = self.mask(y)
        return Segmentation(mask, self._expected_iou(mask.detach(), y.detach(), sixteen.detach()))

    def _expected_iou(self, mask: Tensor, fine: Tensor, coarse: Tensor) -> Tensor:
        chance = mask.sigmoid()
        chosen = (mask > 0).to(mask.dtype)
        hit = (chance * chosen).sum(dim=(2, 3))
        size = chosen.sum(dim=(2, 3)) + 1.0
        missed = (chance * (1 - chosen)).sum(dim=(2, 3))
        # The expected IoU, if the mask's chances are true.
        calibrated = hit / (size + missed)
        unsure = (chance * (1 - chance)).sum(dim=(2, 3)) / size
        expected_size = chance.sum(dim=(2, 3)) + 1.0
        pooled = (fine * chance).sum(dim=(2, 3)) / expected_size
        context = coarse.mean(dim=(2, 3))
        features = torch.cat([context, pooled, calibrated, unsure.clamp(max=4.0)], dim=1)
        out: Tensor = self.iou(features).sigmoid()
        return out


class Segmenter(nn.Module):
    """Encoder and decoder in one pass, one prompt an image."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = Encoder()
        self.decoder = Decoder()

    def forward(self, image: Tensor, prompt: Prompt) -> Segmentation:
        """Segment ``[b, 3, s, s]`` RGB in 0..1."""
        out: Segmentation = self.decoder(self.encoder(image), prompt)
        return out
