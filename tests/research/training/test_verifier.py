"""The training code of the verifier, where PyTorch is installed (extra ``train``)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("onnxruntime")

import onnxruntime
import torch

from research.training.verifier.combine import fitted, rescaled, verifier_logits
from research.training.verifier.data import STORED_PX, Candidates, ChipStream, load, middle, save
from research.training.verifier.network import VerifierNet
from research.training.verifier.train import export, logits, report
from vehanchor.detection.verifier import CHIP_PX, Weights

pytestmark = pytest.mark.slow


def _candidates() -> Candidates:
    rng = np.random.default_rng(0)
    car = np.arange(60) % 2 == 0
    chips = rng.integers(60, 100, (60, STORED_PX, STORED_PX, 3)).astype(np.uint8)
    chips[car, 32:40, 26:46] = 220
    return Candidates(
        chips, car, scores=np.where(car, 0.6, 0.4), sets=np.array(["a", "b", "b"] * 20)
    )


def test_candidates_survive_their_file_and_the_stream_is_seeded(tmp_path: Path) -> None:
    save(_candidates(), tmp_path / "train.npz")
    loaded = load(tmp_path / "train.npz")
    for name, value in _candidates()._asdict().items():
        assert np.array_equal(getattr(loaded, name), value), name
    stream = ChipStream(loaded, 3)
    assert torch.equal(stream[5][0], ChipStream(loaded, 3)[5][0])
    cars = [float(stream[k][1]) for k in range(200)]
    assert 0.4 < np.mean(cars) < 0.6


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the TorchScript exporter
def test_the_file_says_what_the_network_says(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = VerifierNet().eval()
    export(network, tmp_path / "verifier.onnx")
    chips = _candidates().chips
    session = onnxruntime.InferenceSession(tmp_path / "verifier.onnx")
    np.testing.assert_allclose(
        verifier_logits(session, middle(chips)), logits(network, chips), atol=1e-4
    )
    assert verifier_logits(session, np.zeros((0, CHIP_PX, CHIP_PX, 3), np.uint8)).shape == (0,)


def test_the_combination_trusts_whoever_knows() -> None:
    candidates = _candidates()
    rng = np.random.default_rng(0)
    telling = np.where(candidates.car, 1.5, -1.5) + rng.normal(0, 1, 60)
    combination = fitted(
        telling, candidates._replace(scores=np.full(60, 0.5) + rng.uniform(-0.1, 0.1, 60))
    )
    assert combination.verifier > 0.5
    assert Weights(1.0, 0.0, 0.0).score([0.2, 0.9], [5.0, -5.0]).tolist() == pytest.approx(
        [0.2, 0.9]
    )
    same = rescaled(combination, telling, candidates)
    assert same.detector / same.verifier == pytest.approx(
        combination.detector / combination.verifier
    )
    assert any("AUC" in line for line in report(candidates.car, candidates.sets, telling))
