"""The training loop that all networks share, where PyTorch is installed (extra ``train``)."""

from __future__ import annotations

import itertools
import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("torch")

import torch

from research.training.loop import Schedule, load_average, save_atomically, train
from tests.research.training.cut_off import Lines, losses, network, recipe

pytestmark = pytest.mark.slow


class _PowerCutError(Exception):
    pass


def test_an_interrupted_run_ends_where_an_uninterrupted_one_does(tmp_path: Path) -> None:
    steps = itertools.count()

    def interrupted(network: torch.nn.Module, batch: torch.Tensor, device: torch.device) -> dict[str, torch.Tensor]:
        if next(steps) == 14:  # two steps after a checkpoint
            raise _PowerCutError
        return losses(network, batch, device)

    whole = train(network(), Lines(), losses, recipe(), None)
    with pytest.raises(_PowerCutError):
        train(network(), Lines(), interrupted, recipe(), tmp_path)
    torch.manual_seed(99)  # a new process knows nothing of the old one's random numbers
    resumed = train(network(), Lines(), losses, recipe(), tmp_path)
    for name, value in whole.state_dict().items():
        assert torch.equal(value, resumed.state_dict()[name]), name
    loaded = network()
    load_average(loaded, tmp_path)
    assert torch.equal(loaded.state_dict()["0.weight"], whole.state_dict()["0.weight"])


def test_the_number_of_workers_changes_nothing() -> None:
    alone, helped = (train(network(), Lines(), losses, recipe(workers), None) for workers in (0, 2))
    assert all(
        torch.equal(a, b) for a, b in zip(alone.state_dict().values(), helped.state_dict().values(), strict=True)
    )


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


@pytest.mark.skipif(not hasattr(signal, "SIGXFSZ"), reason="Windows has no limit of a file's size")
def test_a_run_survives_a_kill_and_a_full_disk_at_any_byte_and_ends_with_the_same_weights(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "tests.research.training.cut_off", str(tmp_path)]
    done = subprocess.run(command, cwd=Path(__file__).parents[3], capture_output=True, text=True, check=True)
    assert json.loads(done.stdout.splitlines()[-1]) == []
