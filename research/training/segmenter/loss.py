"""Loss of the segmenter: cross-entropy near the object, soft Dice, and the mask's own overlap."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from research.training.segmenter.network import Segmentation

# Weight of pixels far from the object, which are mostly trivial background.
_FAR_WEIGHT = 0.15
_EDGE_WEIGHT = 3.0
_NEAR_CELLS = 17
_EDGE_CELLS = 5


class SegmentationLoss(NamedTuple):
    """Scalars; ``overlap`` is the mean IoU of the batch, for the log."""

    mask: Tensor
    iou: Tensor
    overlap: Tensor


def overlap_of(logits: Tensor, target: Tensor) -> Tensor:
    """IoU ``[b]`` of the masks at their thresholds (logit 0, coverage one half)."""
    ours = logits > 0
    true = target > 0.5
    both = (ours & true).sum(dim=(1, 2, 3))
    either = (ours | true).sum(dim=(1, 2, 3))
    return both / either.clamp(min=1)


def segmentation_loss(prediction: Segmentation, target: Tensor) -> SegmentationLoss:
    """Compare with coverage ``target`` ``[b, 1, h, w]`` in 0..1 at stride 2."""
    logits = prediction.mask
    wide = functional.max_pool2d(target, _NEAR_CELLS, 1, _NEAR_CELLS // 2)
    outer = functional.max_pool2d(target, _EDGE_CELLS, 1, _EDGE_CELLS // 2)
    inner = -functional.max_pool2d(-target, _EDGE_CELLS, 1, _EDGE_CELLS // 2)
    edge = outer - inner
    weight = _FAR_WEIGHT + (1 - _FAR_WEIGHT) * wide + (_EDGE_WEIGHT - 1) * edge
    by_cell = functional.binary_cross_entropy_with_logits(logits, target, reduction="none")
    weighted = (by_cell * weight).sum(dim=(1, 2, 3))
    entropy = (weighted / weight.sum(dim=(1, 2, 3))).mean()
    chance = logits.sigmoid()
    both = (chance * target).sum(dim=(1, 2, 3))
    either = (chance + target).sum(dim=(1, 2, 3))
    dice = (1 - (2 * both + 1) / (either + 1)).mean()
    with torch.no_grad():
        overlap = overlap_of(logits, target)
    return SegmentationLoss(
        entropy + dice,
        functional.mse_loss(prediction.iou[:, 0], overlap.to(logits.dtype)),
        overlap.mean(),
    )
