"""Chip network: from a candidate with its surroundings to its kind, edges and metres."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn

from research.training.detector.network import VehicleNet
from vehanchor.detection.chips import KINDS

_KEPT = {
    0: (8, 4, 20, 3, 13),
    1: (16, 2, 10, 1, 7),
    2: (24, 0, 6, 0, 4),
}  # stage: channels, columns, rows of the middle
_HIDDEN = 96
_N_EDGES = 4
# Logs of the mean length and width of all cars: 4.35 m by 1.80 m.
_MIDDLE_LOG_M = (1.47, 0.585)
_MIDDLE_EDGES = (-0.48, 0.48, -0.195, 0.195)


class Answers(NamedTuple):
    """Outputs for a batch of chips.

    Attributes:
        logit: ``[b]`` of a small vehicle in a fitting box.
        kinds: ``[b, 10]`` logits of ``KINDS``.
        edges: ``[b, 4]`` both ends along and both sides across the body's axis, from the
            candidate's centre, in candidate lengths.
        edge_log_sd: ``[b, 4]`` log of the standard deviation of each.
        turn: ``[b]`` angle from the candidate's axis to the body's, radians.
        log_metres: ``[b, 2]`` log of the length and the width of the body by its looks.
        metres_log_sd: ``[b, 2]`` log of the standard deviation of each.
    """

    logit: Tensor
    kinds: Tensor
    edges: Tensor
    edge_log_sd: Tensor
    turn: Tensor
    log_metres: Tensor
    metres_log_sd: Tensor


class ChipNet(nn.Module):
    """The detector's encoder to stride 16 and two heads; input ``[b, 3, 64, 96]`` RGB in 0..1."""

    def __init__(self) -> None:
        super().__init__()
        detector = VehicleNet()
        self.stem = detector.stem
        self.stages = detector.stages[: len(_KEPT)]
        widths = [
            next(m for m in stage.modules() if isinstance(m, nn.Conv2d)).out_channels
            for stage in self.stages
        ]
        self.middles = nn.ModuleList(
            nn.Sequential(
                nn.Conv2d(widths[k], kept, 1, bias=False),
                nn.BatchNorm2d(kept),
                nn.ReLU(inplace=True),
            )
            for k, (kept, *_) in _KEPT.items()
        )
        cells = [
            kept * (right - left) * (bottom - top)
            for kept, left, right, top, bottom in _KEPT.values()
        ]
        inputs = sum(cells) + sum(widths[1:])
        self.seen = nn.ModuleList(
            nn.Sequential(nn.Linear(inputs, _HIDDEN), nn.ReLU(inplace=True), nn.Dropout(0.2))
            for _ in range(2)
        )
        self.what = nn.Linear(_HIDDEN, 1 + len(KINDS) + 4)
        self.where = nn.Linear(_HIDDEN, 2 * _N_EDGES + 1)

    def forward(self, chips: Tensor) -> Answers:
        """Compute the answers for chips ``[b, 3, 64, 96]``."""
        x = self.stem(chips)
        parts = []
        for k, stage in enumerate(self.stages):
            x = stage(x)
            _, left, right, top, bottom = _KEPT[k]
            kept = x[:, :, top:bottom, left:right]
            parts.append(self.middles[k](kept).flatten(1))
            if k:
                parts.append(x.mean(dim=(2, 3)))
        joined = torch.cat(parts, dim=1)
        what = self.what(self.seen[0](joined))
        where = self.where(self.seen[1](joined))
        n = 1 + len(KINDS)
        edges = 0.1 * where[:, :4] + where.new_tensor(_MIDDLE_EDGES)
        return Answers(
            what[:, 0],
            what[:, 1:n],
            edges=edges,
            edge_log_sd=where[:, 4:8].clamp(-3, 3) - 3.5,
            turn=0.1 * where[:, 8],
            log_metres=0.1 * what[:, n : n + 2] + what.new_tensor(_MIDDLE_LOG_M),
            metres_log_sd=what[:, n + 2 : n + 4].clamp(-2, 2) - 2.5,
        )
