"""The training loop of all networks here: optimiser, schedule, moving average, checkpoints.

Everything is counted in steps, never in minutes, and the example for step k is a function of the
seed and k alone (``Examples.__getitem__``). So a run that was interrupted and resumed ends with the
same weights as one that was not, and the same seed gives the same file on the same machine with the
same number of threads.
"""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader

from vehanchor.storage.atomic import whole_file

_CLIP_NORM = 5.0
_CHECKPOINT = "checkpoint.pt"


class Examples(Protocol):
    """Endless, seeded stream of examples, which ``DataLoader`` reads by index from anywhere."""

    def __getitem__(self, index: int, /) -> Any:
        """Make the example of an index, always the same one."""


@dataclass(frozen=True)
class Schedule:
    """Learning rate by step: a linear rise, a plateau, a cosine down.

    Attributes:
        steps: in all.
        peak: highest rate.
        warm_up: steps of the rise.
        last: rate at the end, as a share of the peak.
        held: share of the steps after which the rate begins to fall; a run that must be cut short
            keeps its plateau.
    """

    steps: int
    peak: float
    warm_up: int = 200
    last: float = 0.02
    held: float = 0.0

    def rate(self, step: int) -> float:
        """Compute the learning rate of a step, counted from 0."""
        if step < self.warm_up:
            return self.peak * (step + 1) / self.warm_up
        start = max(self.warm_up, self.held * self.steps)
        progress = min(1.0, max(0.0, (step - start) / max(1.0, self.steps - start)))
        # Half a cosine, from 1 to 0.
        remaining = 0.5 * (1 + math.cos(math.pi * progress))
        return self.peak * (self.last + (1 - self.last) * remaining)


@dataclass(frozen=True)
class Recipe:
    """How a network is trained.

    Attributes:
        schedule: of the learning rate.
        batch: examples a step; None where an example is a whole batch.
        average: decay of the moving average of the weights; 0 takes the last weights.
        weight_decay: on kernels, not on biases and normalisations.
        bfloat16: mixed precision, faster where the processor has it.
        checkpoint_every: steps.
        log_every: steps.
        workers: processes that make examples; their number does not change the result.
    """

    schedule: Schedule
    batch: int | None
    average: float = 0.998
    weight_decay: float = 0.02
    bfloat16: bool = False
    checkpoint_every: int = 100
    log_every: int = 50
    workers: int = 1


Losses = Callable[[nn.Module, Any, torch.device], Mapping[str, Tensor]]


def train(
    network: nn.Module, examples: Examples, losses: Losses, recipe: Recipe, run: Path | None
) -> nn.Module:
    """Train a network, resuming from ``run/checkpoint.pt`` where there is one.

    Args:
        network: to be trained, on the CPU; moved to a GPU where there is one.
        examples: item ``step * batch + k`` is the k-th example of a step.
        losses: of network, batch and device; their sum is minimised, their means are printed.
        recipe: the numbers.
        run: folder of the checkpoint; None keeps none.

    Returns:
        The moving average of the network, in evaluation mode, on the CPU.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    network.to(device)
    averaged = copy.deepcopy(network).eval()
    optimizer = _optimizer(network, recipe.weight_decay)
    first = 0
    steps = recipe.schedule.steps
    if run and (run / _CHECKPOINT).exists():
        state = torch.load(run / _CHECKPOINT, map_location=device, weights_only=True)
        network.load_state_dict(state["network"])
        averaged.load_state_dict(state["averaged"])
        optimizer.load_state_dict(state["optimizer"])
        torch.set_rng_state(state["random"].cpu())
        first = state["step"]
        print(f"resumed at step {first}", flush=True)
    batches = _batches(examples, recipe, first)
    network.train()
    sums: dict[str, float] = {}
    started = time.monotonic()
    for step in range(first, steps):
        for group in optimizer.param_groups:
            group["lr"] = recipe.schedule.rate(step)
        batch = next(batches)
        with torch.autocast(device.type, torch.bfloat16, enabled=recipe.bfloat16):
            parts = losses(network, batch, device)
        optimizer.zero_grad(set_to_none=True)
        torch.stack(list(parts.values())).sum().backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(network.parameters(), _CLIP_NORM)
        optimizer.step()
        done = step + 1
        _follow(averaged, network, min(recipe.average, done / (done + 9)))
        for name, part in parts.items():
            sums[name] = sums.get(name, 0.0) + part.item()
        if done % recipe.log_every == 0:
            pace = (time.monotonic() - started) / (done - first)
            means = " ".join(
                f"{name} {total / recipe.log_every:.4f}" for name, total in sums.items()
            )
            print(f"{done} {means} {pace:.2f} s/step", flush=True)
            sums = {}
        if run and (done % recipe.checkpoint_every == 0 or done == steps):
            state = {
                "network": network.state_dict(),
                "averaged": averaged.state_dict(),
                "optimizer": optimizer.state_dict(),
                "random": torch.get_rng_state(),
                "step": done,
            }
            save_atomically(state, run / _CHECKPOINT)
    return averaged.to("cpu")


def _optimizer(network: nn.Module, weight_decay: float) -> torch.optim.Optimizer:
    """AdamW; biases and normalisation keep their weights."""
    kernels = [p for p in network.parameters() if p.ndim > 1]
    others = [p for p in network.parameters() if p.ndim <= 1]
    return torch.optim.AdamW(
        [{"params": kernels, "weight_decay": weight_decay}, {"params": others, "weight_decay": 0.0}]
    )


def _batches(examples: Examples, recipe: Recipe, first: int) -> Iterator[Any]:
    """Load the batches from a step on."""
    size = recipe.batch or 1
    loader: DataLoader[Any] = DataLoader(
        examples,  # type: ignore[arg-type]  # DataLoader uses only __getitem__
        batch_size=recipe.batch,
        sampler=range(first * size, recipe.schedule.steps * size),
        num_workers=recipe.workers,
        prefetch_factor=4 if recipe.workers else None,
        generator=torch.Generator(),  # its draw must not move the state that a checkpoint keeps
    )
    return iter(loader)


def load_average(network: nn.Module, run: Path) -> None:
    """Put the moving average of a run into ``network``."""
    network.load_state_dict(
        torch.load(run / _CHECKPOINT, map_location="cpu", weights_only=True)["averaged"]
    )


def save_atomically(state: object, path: Path) -> None:
    """Write so that whoever reads finds the old file or the new one, never half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as partial:
        torch.save(state, partial)


@torch.no_grad()
def _follow(averaged: nn.Module, network: nn.Module, keep: float) -> None:
    for slow, fast in zip(
        averaged.state_dict().values(), network.state_dict().values(), strict=True
    ):
        if slow.dtype.is_floating_point and keep:
            slow.lerp_(fast, 1 - keep)
        else:
            slow.copy_(fast)
