"""The training loss: penalty-reduced focal loss on the heat map, L1 on the boxes' numbers."""

from __future__ import annotations

import torch
from torch.nn import functional

from research.training.detector.data import Target
from research.training.detector.network import Prediction

# Weights of offset x and y, log length, log width, cos 2t and sin 2t.
_SHAPE_WEIGHT = (0.5, 0.5, 2.0, 1.0, 0.6, 0.6)


def detection_loss(prediction: Prediction, target: Target) -> tuple[torch.Tensor, torch.Tensor]:
    """Heat-map loss and shape loss of a batch.

    The heat map follows CenterNet (Zhou et al., "Objects as Points", equation 1) with alpha 2 and
    beta 4. L1 on the logarithm of the length has the median as its minimum, hence no bias from a
    skewed residual.

    Returns:
        The two scalar losses, to be added.
    """
    logits = prediction.heat.float()
    log_p = functional.logsigmoid(logits)
    log_not_p = functional.logsigmoid(-logits)
    p = logits.sigmoid()
    centre = (target.heat > 0.999).float()
    positive = centre * (1 - p) ** 2 * log_p
    negative = (1 - centre) * (1 - target.heat) ** 4 * p**2 * log_not_p
    count = centre.sum().clamp(min=1.0)
    heat = -((positive + negative) * target.care).sum() / count
    channel = torch.tensor(_SHAPE_WEIGHT, device=logits.device).view(1, -1, 1, 1)
    residual = (prediction.shape.float() - target.shape).abs() * channel * target.weight
    return heat, residual.sum() / target.weight.sum().clamp(min=1.0)
