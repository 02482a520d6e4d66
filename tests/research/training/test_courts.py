"""Training code of the network that proposes courts, where PyTorch is installed."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from research.training.courts.data import Court, CropStream, Picture  # noqa: E402
from research.training.courts.network import CourtNet  # noqa: E402
from research.training.courts.train import export, losses  # noqa: E402
from tests.skill.courts.drawing import draw_court  # noqa: E402 - PyTorch may be missing
from vehanchor.courts.network import CourtNetwork  # noqa: E402
from vehanchor.courts.templates import TENNIS  # noqa: E402
from vehanchor.imagery.sources.opening import open_raster  # noqa: E402

pytestmark = pytest.mark.slow


def _groups() -> list[list[Picture]]:
    pixels = draw_court(TENNIS, 0.3, degrees=20.0)
    court = Picture(pixels, 0.3, (Court(127.5, 127.5, math.radians(20), 0),), sure=True)
    return [[court], [court], [Picture(np.full((256, 256, 3), 90, np.uint8), 0.3, (), sure=True)]]


def test_a_crop_tells_where_its_court_is_and_how_it_lies() -> None:
    stream = CropStream(_groups(), 0)
    pixels, targets, weights = stream[3]
    assert pixels.shape == (3, 96, 96)
    assert targets.shape == (5, 12, 12)
    assert weights.shape == (2, 12, 12)
    again = stream[3]
    assert all(
        torch.equal(one, two) for one, two in zip((pixels, targets, weights), again, strict=True)
    )
    with_court = [stream[k][1] for k in range(12)]
    assert any(example[0].max() > 0.5 for example in with_court)
    assert all(example[1].max() == 0 for example in with_court)  # none of them is of basketball


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the TorchScript exporter
def test_a_network_that_has_learned_one_court_proposes_it(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = CourtNet()
    stream = CropStream(_groups(), 0)
    optimizer = torch.optim.AdamW(network.parameters(), lr=4e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 4e-3, total_steps=180)
    for step in range(180):
        parts = [
            torch.stack(column)
            for column in zip(*(stream[step * 6 + k] for k in range(6)), strict=True)
        ]
        loss = torch.stack(
            [*losses(network, (parts[0], parts[1], parts[2]), torch.device("cpu")).values()]
        ).sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    export(network.eval(), tmp_path / "courts.onnx")
    with open_raster(draw_court(TENNIS, 0.3, degrees=20.0)) as raster:
        proposals = CourtNetwork(tmp_path / "courts.onnx").propose(raster, 2)
    best = max(proposals, key=lambda column: column.share)
    assert best.which == 0
    assert math.hypot(best.pose.x - 127.5, best.pose.y - 127.5) < 24
