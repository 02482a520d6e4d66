"""Train the head for drawn things: ``python -m research.training.letters.train FEATURES OUT``.

``FEATURES`` has the files of ``research.training.letters.features``. The head has one hidden layer
on the frozen features. It is trained with equal weights of drawn and photographed candidates;
within these, of each layout and each place. ``--without PLACE`` leaves places out. The run
continues from ``OUT/checkpoint.pt`` and writes ``OUT/head.npz``, which
``research.training.letters.export`` puts into the chip network.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

Features: TypeAlias = NDArray[np.float16]
"""Features ``[n, f]``."""

Labels: TypeAlias = NDArray[np.float32]
"""1 ``[n]`` for a drawn thing, 0 for a photographed one."""

_HIDDEN = 48
_DROPOUT = 0.3
_RATE = 1e-3
_WEIGHT_DECAY = 0.02
_BATCH = 512
_LEAST_SD = 1e-2


class Examples(NamedTuple):
    """Features of views, whether they show a drawn thing, and their weights."""

    features: Features
    drawn: Labels
    weights: Labels


class Head(nn.Module):
    """One hidden layer on standardised features.

    Args:
        mean: ``[f]`` of the features.
        sd: ``[f]`` of the features.
    """

    mean: Tensor
    sd: Tensor

    def __init__(self, mean: Tensor, sd: Tensor) -> None:
        super().__init__()
        self.register_buffer("mean", mean)
        self.register_buffer("sd", sd)
        self.hidden = nn.Linear(len(mean), _HIDDEN)
        self.dropout = nn.Dropout(_DROPOUT)
        self.out = nn.Linear(_HIDDEN, 1)

    def forward(self, features: Tensor) -> Tensor:
        """Compute the log odds ``[b]`` of a drawn thing."""
        standard = (features - self.mean) / self.sd
        hidden = torch.relu(self.hidden(self.dropout(standard)))
        return self.out(hidden)[:, 0]

    def folded(self) -> dict[str, NDArray[np.float32]]:
        """Give the weights of two dense layers on the features as they are."""
        weight = self.hidden.weight / self.sd
        bias = self.hidden.bias - weight @ self.mean
        tensors = {
            "hidden_weight": weight,
            "hidden_bias": bias,
            "out_weight": self.out.weight,
            "out_bias": self.out.bias,
        }
        return {name: tensor.detach().float().numpy() for name, tensor in tensors.items()}


def balanced(groups: NDArray[np.str_]) -> Labels:
    """Give each group the weight of the root of its number, and all together a mean of 1."""
    _, inverse, counts = np.unique(groups, return_inverse=True, return_counts=True)
    weights = 1.0 / np.sqrt(counts[inverse])
    return (weights / weights.mean()).astype(np.float32)


def train(examples: Examples, steps: int, seed: int, out: Path) -> Head:
    """Train a head; a checkpoint in ``out`` continues the run."""
    torch.manual_seed(seed)
    features = torch.from_numpy(examples.features)
    drawn = torch.from_numpy(examples.drawn)
    weights = torch.from_numpy(examples.weights)
    mean = features.float().mean(0)
    sd = features.float().std(0).clamp(min=_LEAST_SD)
    head = Head(mean, sd)
    optimiser = torch.optim.AdamW(head.parameters(), _RATE, weight_decay=_WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    first = 0
    checkpoint = out / "checkpoint.pt"
    if checkpoint.exists():
        state = torch.load(checkpoint)
        head.load_state_dict(state["head"])
        optimiser.load_state_dict(state["optimiser"])
        schedule.load_state_dict(state["schedule"])
        first = state["step"]
    for step in range(first, steps):
        generator = torch.Generator().manual_seed(1_000_003 * seed + step)
        chosen = torch.randint(len(drawn), (_BATCH,), generator=generator)
        logits = head(features[chosen].float())
        losses = nn.functional.binary_cross_entropy_with_logits(
            logits, drawn[chosen], reduction="none"
        )
        loss = (losses * weights[chosen]).mean()
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
        if (step + 1) % 500 == 0:
            print(f"step {step + 1}: loss {loss.item():.4f}", flush=True)
            state = {
                "head": head.state_dict(),
                "optimiser": optimiser.state_dict(),
                "schedule": schedule.state_dict(),
                "step": step + 1,
            }
            torch.save(state, checkpoint)
    return head.eval()


def read_examples(folder: Path, without: list[str]) -> Examples:
    """Read the features of drawn and photographed candidates, without some places."""
    views = []
    drawn = []
    groups = []
    for path in sorted(folder.glob("features_*.npz")):
        with np.load(path) as table:
            kept = ~np.isin(table["groups"], without)
            of_file = table["views"][kept]
            n_views = of_file.shape[1]
            views.append(of_file.reshape(-1, of_file.shape[2]))
            drawn.append(table["drawn"][kept].repeat(n_views))
            groups.append(table["groups"][kept].repeat(n_views))
    labels = np.concatenate(drawn).astype(np.float32)
    names = np.concatenate(groups)
    weights = np.zeros(len(labels), np.float32)
    for label in (0, 1):
        of_label = labels == label
        weights[of_label] = balanced(names[of_label]) * len(labels) / (2 * of_label.sum())
    return Examples(np.concatenate(views), labels, weights)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("features", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--without", action="append", default=[])
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    examples = read_examples(options.features, options.without)
    head = train(examples, options.steps, seed=options.seed, out=options.out)
    weights = head.folded()
    np.savez(options.out / "head.npz", **weights)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
