"""The training code of the chip network, where PyTorch is installed (extra ``train``)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("onnxruntime")

import torch

from research.training.car_verifier.store import Rows
from research.training.car_verifier.stream import draw_move
from research.training.chips.chip_network import CHIP_COLUMNS, CHIP_ROWS, KINDS, ChipNetwork
from research.training.chips.export import export
from research.training.chips.kinds import group_of, kind_index
from research.training.chips.network import ChipNet
from research.training.chips.stream import (
    NOT_A_CAR,
    Batch,
    Bodies,
    edges_of_box,
    moved_edges,
    target_of_row,
)
from research.training.chips.train import losses
from vehanchor.models.runtime import Runtime

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("seed", range(8))
def test_moved_edges_touch_the_moved_body(seed: int) -> None:
    rng = np.random.default_rng(seed)
    move, turn, edges = draw_move(rng), float(rng.normal(0, 0.1)), np.array([-0.5, 0.44, -0.2, 0.23])
    along, across = np.array([np.cos(turn), np.sin(turn)]), np.array([-np.sin(turn), np.cos(turn)])
    corners = np.array([a * along + b * across for a in edges[:2] for b in edges[2:]])
    seen = (corners - move.shift) @ np.linalg.inv(move.matrix).T
    moved, turned = moved_edges(edges, turn, move)
    lengthwise = seen @ [np.cos(turned), np.sin(turned)]
    sideways = seen @ [-np.sin(turned), np.cos(turned)]
    wanted = [lengthwise.min(), lengthwise.max(), sideways.min(), sideways.max()]
    np.testing.assert_allclose(moved, wanted, atol=1e-6)
    assert abs(turned) < 0.5


def test_a_missing_edge_stays_missing_wherever_a_mirror_puts_it() -> None:
    move = draw_move(np.random.default_rng(1))._replace(flip=np.array([-1.0, 1.0]))
    moved, _ = moved_edges(np.array([-0.5, np.nan, -0.2, 0.2]), 0.0, move)
    assert np.isnan(moved[0])
    assert moved[1] == pytest.approx((0.5 + move.shift @ [1, 0]) / move.scale, abs=0.1)


def test_the_edges_of_an_exact_box() -> None:
    np.testing.assert_allclose(edges_of_box(np.array([0.1, -0.05, 0.0, np.log(0.4), 0.0])), [-0.4, 0.6, -0.25, 0.15])


def _rows(set_name: str, car: int, kind: int) -> Rows:
    box = np.array([[0.0, 0.0, 0.0, np.log(0.42), 0.0]], np.float32)
    one = np.ones(1, np.float32)
    return Rows(
        np.array([car], np.int8), np.array([kind], np.int8), box, one, np.log(np.array([4.4], np.float32)), 40 * one,
        one, one, np.array([set_name]), np.array(["file"]),
    )  # fmt: skip


def test_only_exact_boxes_teach_edges_and_other_things_are_no_kind_of_car() -> None:
    unknown = Bodies(np.full((1, 2), np.nan, np.float32), np.zeros((1, 2), np.float32))
    rendered = target_of_row(_rows("pasted", 1, 3), unknown, 0)
    assert rendered.edge_weight > 0
    assert np.exp(rendered.log_metres) == pytest.approx([4.4, 0.42 * 4.4], rel=1e-3)
    labelled = target_of_row(_rows("ucm", 1, -1), unknown, 0)
    assert labelled.edge_weight == labelled.metres_weight[1] == 0
    measured = Bodies(np.log(np.array([[4.2, 1.7]], np.float32)), np.full((1, 2), 0.5, np.float32))
    assert np.exp(target_of_row(_rows("ucm", 1, -1), measured, 0).log_metres) == pytest.approx([4.2, 1.7], rel=1e-3)
    assert target_of_row(_rows("ucm", 0, KINDS.index("other")), unknown, 0).kind == NOT_A_CAR
    assert target_of_row(_rows("lorry_ucm", 0, KINDS.index("lorry")), unknown, 0).kind == KINDS.index("lorry")


def test_kinds_that_an_eye_reads() -> None:
    assert group_of(kind_index("kei")) == group_of(kind_index("small")) == "small"
    assert group_of(kind_index("roof")) == "other"
    assert kind_index("unclear") == -1


def _batch(n: int) -> Batch:
    nothing = torch.full((n, 4), torch.nan)
    return Batch(
        torch.zeros(n, 3, CHIP_ROWS, CHIP_COLUMNS, dtype=torch.uint8), torch.full((n,), torch.nan),
        torch.full((n,), -1), torch.ones(n), nothing, torch.zeros(n), torch.zeros(n), nothing[:, :2],
        torch.zeros(n, 2),
    )  # fmt: skip


def test_what_nobody_knows_costs_nothing_and_what_is_known_pulls() -> None:
    network = ChipNet().eval()
    parts = losses(network, _batch(2), torch.device("cpu"))
    assert all(part.item() == 0 for part in parts.values())
    known = _batch(2)._replace(car=torch.ones(2), edges=torch.zeros(2, 4), edge_weight=torch.ones(2))
    parts = losses(network, known, torch.device("cpu"))
    assert min(parts[name].item() for name in ("car", "edges", "width")) > 0


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the TorchScript exporter
def test_the_file_answers_as_the_network_and_takes_half_of_its_space(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = ChipNet().eval()
    export(network, tmp_path / "chips.onnx")
    numbers = sum(values.numel() for values in network.parameters())
    assert (tmp_path / "chips.onnx").stat().st_size < 2.4 * numbers
    chips = np.random.default_rng(0).integers(0, 255, (3, CHIP_ROWS, CHIP_COLUMNS, 3), np.uint8)
    said = ChipNetwork(tmp_path / "chips.onnx", runtime=Runtime(threads=1)).answers(chips, views=1)
    with torch.no_grad():
        wanted = network(torch.from_numpy(chips.transpose(0, 3, 1, 2).copy()).float() / 255)
    np.testing.assert_allclose(said.edges, wanted.edges.numpy(), atol=2e-3)
    np.testing.assert_allclose(said.logit, wanted.logit.numpy(), atol=2e-2)
