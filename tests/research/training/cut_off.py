"""A training run that is killed, or whose disk is full, while it writes.

``python -m tests.research.training.cut_off FOLDER``.

Prints a line of JSON with what was found wrong. In a process of its own, which has one thread and can be copied.
"""

from __future__ import annotations

import itertools
import json
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import onnx
import torch
import torch._dynamo

from research.training.loop import Recipe, Schedule, load_average, train
from research.training.onnx_file import write_metadata, write_onnx
from tests.faults import REFUSED, WRITTEN, limited

_LATE_IMPORTS = (torch._dynamo,)  # by the first optimiser: here, not in each child
_KILLED_AT = 14  # two steps after a checkpoint


class Lines:
    """Examples of y = 3 x."""

    def __getitem__(self, index: int) -> torch.Tensor:
        return torch.rand(4, generator=torch.Generator().manual_seed(index))


def network() -> torch.nn.Sequential:
    """One with random numbers of its own, so that resuming must restore their state."""
    torch.manual_seed(1)
    return torch.nn.Sequential(
        torch.nn.Linear(4, 8), torch.nn.BatchNorm1d(8), torch.nn.Dropout(0.4), torch.nn.Linear(8, 4)
    )


def losses(network: torch.nn.Module, batch: torch.Tensor, device: torch.device) -> dict[str, torch.Tensor]:
    """Of the lines."""
    return {"square": (network(batch.to(device)) - 3 * batch.to(device)).square().mean()}


def recipe(workers: int = 0) -> Recipe:
    """Thirty steps, a checkpoint every four."""
    return Recipe(
        Schedule(30, 1e-2, warm_up=5), batch=6, average=0.9, checkpoint_every=4, log_every=100, workers=workers
    )


def _train(run: Path) -> None:
    torch.set_num_threads(1)
    train(network(), Lines(), losses, recipe(), run)


def _train_until_killed(run: Path) -> None:
    steps = itertools.count()

    def deadly(network: torch.nn.Module, batch: torch.Tensor, device: torch.device) -> dict[str, torch.Tensor]:
        if next(steps) == _KILLED_AT:
            os.kill(os.getpid(), signal.SIGKILL)
        return losses(network, batch, device)

    torch.set_num_threads(1)
    train(network(), Lines(), deadly, recipe(), run)


def _average(run: Path) -> list[list[float]]:
    loaded = network()
    load_average(loaded, run)
    return [value.flatten().tolist() for value in loaded.state_dict().values()]


def _run(folder: Path) -> Iterator[str]:
    """Kill a run between two checkpoints and at bytes of the next one, fill its disk, and let it go on."""
    whole, cut = folder / "whole", folder / "cut"
    if limited(lambda: _train(whole), None, killed=False) != WRITTEN:
        yield "the run that nothing disturbs fails"
    if limited(lambda: _train_until_killed(cut), None, killed=False) != -signal.SIGKILL:
        yield "the run was not killed"
    checkpoint = cut / "checkpoint.pt"
    before = checkpoint.read_bytes()
    for killed in (True, False):
        for n_bytes in (0, len(before) // 2, len(before) - 1000):
            end = limited(lambda: _train(cut), n_bytes, killed=killed)
            if end != (-signal.SIGXFSZ if killed else REFUSED) or checkpoint.read_bytes() != before:
                yield f"a checkpoint at byte {n_bytes}, killed {killed}, ends with {end}"
    if limited(lambda: _train(cut), None, killed=False) != WRITTEN or _average(cut) != _average(whole):
        yield "the run that goes on ends with other weights"


def _exported(folder: Path) -> Iterator[str]:
    """Cut a network's file off, and its file with other metadata."""
    path = folder / "network.onnx"
    example = (torch.zeros(1, 4),)
    works = {
        "export": lambda: write_onnx(network(), example, path, ["x"], ["y"]),
        "metadata": lambda: write_metadata(path, {"name": "other"}),
    }
    if limited(works["export"], None, killed=False) != WRITTEN:
        yield "the network is not exported"
    before = path.read_bytes()
    for name, work in works.items():
        for killed in (True, False):
            for n_bytes in (0, len(before) // 2):
                end = limited(work, n_bytes, killed=killed)
                if end != (-signal.SIGXFSZ if killed else REFUSED) or path.read_bytes() != before:
                    yield f"{name} at byte {n_bytes}, killed {killed}, ends with {end}"
    onnx.checker.check_model(str(path))


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    print(json.dumps([*_run(folder), *_exported(folder)]))
