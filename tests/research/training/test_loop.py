"""The training loop that all networks share, where PyTorch is installed (extra ``train``)."""

from __future__ import annotations

import itertools
from pathlib import Path

import pytest

pytest.importorskip("torch")

import torch

from research.training.loop import Recipe, Schedule, load_average, save_atomically, train

pytestmark = pytest.mark.slow


class _Lines:
    """Examples of y = 3 x."""

    def __getitem__(self, index: int) -> torch.Tensor:
        return torch.rand(4, generator=torch.Generator().manual_seed(index))


def _network() -> torch.nn.Sequential:
    """One with random numbers of its own, so that resuming must restore their state."""
    torch.manual_seed(1)
    return torch.nn.Sequential(
        torch.nn.Linear(4, 8), torch.nn.BatchNorm1d(8), torch.nn.Dropout(0.4), torch.nn.Linear(8, 4)
    )


def _losses(
    network: torch.nn.Module, batch: torch.Tensor, device: torch.device
) -> dict[str, torch.Tensor]:
    return {"square": (network(batch.to(device)) - 3 * batch.to(device)).square().mean()}


_RECIPE = Recipe(
    Schedule(30, 1e-2, warm_up=5),
    batch=6,
    average=0.9,
    checkpoint_every=4,
    log_every=100,
    workers=0,
)


class _PowerCutError(Exception):
    pass


def test_an_interrupted_run_ends_where_an_uninterrupted_one_does(tmp_path: Path) -> None:
    steps = itertools.count()

    def interrupted(
        network: torch.nn.Module, batch: torch.Tensor, device: torch.device
    ) -> dict[str, torch.Tensor]:
        if next(steps) == 14:  # two steps after a checkpoint
            raise _PowerCutError
        return _losses(network, batch, device)

    whole = train(_network(), _Lines(), _losses, _RECIPE, None)
    with pytest.raises(_PowerCutError):
        train(_network(), _Lines(), interrupted, _RECIPE, tmp_path)
    torch.manual_seed(99)  # a new process knows nothing of the old one's random numbers
    resumed = train(_network(), _Lines(), _losses, _RECIPE, tmp_path)
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name
    loaded = _network()
    load_average(loaded, tmp_path)
    assert torch.equal(loaded.state_dict()["0.weight"], whole.state_dict()["0.weight"])


def test_the_rate_rises_stays_and_falls() -> None:
    schedule = Schedule(1000, 0.1, warm_up=100, last=0.02, held=0.6)
    assert schedule.rate(0) == pytest.approx(0.001)
    assert schedule.rate(100) == schedule.rate(599) == 0.1
    assert 0.002 < schedule.rate(800) < 0.1
    assert schedule.rate(1000) == pytest.approx(0.002)


def test_a_checkpoint_that_cannot_be_written_leaves_the_old_one(tmp_path: Path) -> None:
    save_atomically({"step": 1}, tmp_path / "checkpoint.pt")
    with pytest.raises(Exception, match="pickle"):
        save_atomically({"step": lambda: 2}, tmp_path / "checkpoint.pt")
    assert torch.load(tmp_path / "checkpoint.pt", weights_only=True) == {"step": 1}
