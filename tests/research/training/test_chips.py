"""The training code of the chip network, where PyTorch is installed (extra ``train``)."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("torch")
pytest.importorskip("onnxruntime")

import onnx
import torch

from research.scenes.fleet import Fleet
from research.training.chips.export import export
from research.training.chips.mine import Named, chia_images, rows_of
from research.training.chips.network import ChipNet
from research.training.chips.paste import Ground, pasted
from research.training.chips.store import STORED_PX, Rows
from research.training.chips.stream import (
    NOT_A_CAR,
    Batch,
    Bodies,
    draw_move,
    moved_edges,
    target_of_row,
)
from research.training.chips.train import losses
from research.training.detector.data import TrainImage
from research.training.letters.export import HEAD_PREFIX, with_head
from research.training.warm_start import load_exported
from vehanchor.detection.boxes import box_corners
from vehanchor.detection.chips import CHIP_COLUMNS, CHIP_ROWS, KINDS, ChipNetwork
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import auxiliary_model, resolve_model

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("seed", range(8))
def test_moved_edges_touch_the_moved_body(seed: int) -> None:
    rng = np.random.default_rng(seed)
    move = draw_move(rng)
    turn = float(rng.normal(0, 0.1))
    edges = np.array([-0.5, 0.44, -0.2, 0.23])
    along = np.array([np.cos(turn), np.sin(turn)])
    across = np.array([-np.sin(turn), np.cos(turn)])
    corners = np.array([a * along + b * across for a in edges[:2] for b in edges[2:]])
    moved_corners = (corners - move.shift) @ np.linalg.inv(move.matrix).T
    moved, turned = moved_edges(edges, turn, move)
    lengthwise = moved_corners @ [np.cos(turned), np.sin(turned)]
    sideways = moved_corners @ [-np.sin(turned), np.cos(turned)]
    expected = [lengthwise.min(), lengthwise.max(), sideways.min(), sideways.max()]
    np.testing.assert_allclose(moved, expected, atol=1e-6)
    assert abs(turned) < 0.5


def _rows(set_name: str, car: int, kind: int) -> Rows:
    return Rows.unlabelled(np.array([40.0]), set_name, "file")._replace(
        car=np.array([car], np.int8),
        type=np.array([kind], np.int8),
        box=np.array([[0.0, 0.0, 0.0, np.log(0.42), 0.0]], np.float32),
        log_length_m=np.log(np.array([4.4], np.float32)),
    )


UNMEASURED = Bodies(np.full((1, 2), np.nan, np.float32), np.zeros((1, 2), np.float32))


def test_an_exact_box_teaches_edges() -> None:
    rendered = target_of_row(_rows("pasted", 1, 3), UNMEASURED, 0)
    assert rendered.edge_weight > 0
    assert np.exp(rendered.log_metres) == pytest.approx([4.4, 0.42 * 4.4], rel=1e-3)


def test_a_labelled_box_teaches_no_edges() -> None:
    labelled = target_of_row(_rows("ucm", 1, -1), UNMEASURED, 0)
    assert labelled.edge_weight == labelled.metres_weight[1] == 0


def test_a_measured_body_teaches_its_metres() -> None:
    measured = Bodies(np.log(np.array([[4.2, 1.7]], np.float32)), np.full((1, 2), 0.5, np.float32))
    target = target_of_row(_rows("ucm", 1, -1), measured, 0)
    assert np.exp(target.log_metres) == pytest.approx([4.2, 1.7], rel=1e-3)


def test_an_object_that_is_not_a_car_has_no_kind_of_car() -> None:
    other = _rows("ucm", 0, KINDS.index("other"))
    lorry = _rows("lorry_ucm", 0, KINDS.index("lorry"))
    assert target_of_row(other, UNMEASURED, 0).kind == NOT_A_CAR
    assert target_of_row(lorry, UNMEASURED, 0).kind == KINDS.index("lorry")


def _batch(n: int) -> Batch:
    return Batch(
        chip=torch.zeros(n, 3, CHIP_ROWS, CHIP_COLUMNS, dtype=torch.uint8),
        car=torch.full((n,), torch.nan),
        kind=torch.full((n,), -1),
        kind_weight=torch.ones(n),
        edges=torch.full((n, 4), torch.nan),
        turn=torch.zeros(n),
        edge_weight=torch.zeros(n),
        log_metres=torch.full((n, 2), torch.nan),
        metres_weight=torch.zeros(n, 2),
    )


def test_unknown_targets_have_no_loss() -> None:
    parts = losses(ChipNet().eval(), _batch(2), torch.device("cpu"))
    assert all(part.item() == 0 for part in parts.values())


def test_known_targets_have_a_loss() -> None:
    batch = _batch(2)._replace(
        car=torch.ones(2), edges=torch.zeros(2, 4), edge_weight=torch.ones(2)
    )
    parts = losses(ChipNet().eval(), batch, torch.device("cpu"))
    assert min(parts[name].item() for name in ("car", "edges", "width")) > 0


def _rectangle(side: int, box: NDArray[np.float64]) -> NDArray[np.uint8]:
    image = np.zeros((side, side, 3), np.uint8)
    corners = np.round((box_corners(box[None])[0] - 0.5) * 256).astype(np.int32)
    cv2.fillPoly(image, [corners], (255, 255, 255), cv2.LINE_AA, 8)
    return image


def test_boxes_that_fit_in_part_teach_nothing() -> None:
    car = np.array([[60.0, 60.0, 30.0, 12.0, 0.0]])
    sample = TrainImage(
        "estonia",
        np.zeros((120, 120, 3), np.uint8),
        boxes=car,
        ignore=np.zeros((0, 4, 2)),
        clutter=np.zeros((0, 2)),
        car_px=22.5,
    )
    beside = car + np.array([0, 18, 0, 0, 0])
    doubtful = car + np.array([12, 0, 0, 0, 0])
    boxes = np.concatenate([car + np.array([1, 0, 0, 0, 0]), beside, doubtful])
    rows, can_train = rows_of(
        Named(sample, "a.jpg", set="estonia", labels=None), boxes, np.full(3, 0.5), np.full(3, 0.5)
    )
    assert rows.car.tolist()[:2] == [1, 0]
    assert can_train.tolist() == [True, True, False]
    assert rows.log_length_m[0] == pytest.approx(np.log(30 * 4.5 / 22.5), abs=1e-5)
    assert KINDS[rows.type[1]] == "other"


def test_odd_numbers_of_chia_train_with_their_cars(tmp_path: Path) -> None:
    crops = tmp_path / "chia" / "crops"
    crops.mkdir(parents=True)
    for number in (16, 17):
        cv2.imwrite(str(crops / f"DJI_00{number}.jpg"), np.full((1280, 1280, 3), 90, np.uint8))
    table = "file,gsd_m_per_px\ncrops/DJI_0016.jpg,0.018\ncrops/DJI_0017.jpg,0.018\n"
    (tmp_path / "chia" / "crops.csv").write_text(table)
    (only,) = chia_images(tmp_path)
    assert only.file == "DJI_0017.jpg"
    assert not len(only.sample.boxes)
    # A car, a part of it, and ground.
    boxes = [
        [636.6, 540.1, 250.0, 110.0, 0.3],
        [636.6, 540.1, 120.0, 50.0, 0.3],
        [100.0, 900.0, 110.0, 50.0, 0.3],
    ]
    rows, can_train = rows_of(only, np.array(boxes), np.ones(3), np.ones(3))
    assert can_train.tolist() == [True, False, True]
    assert (rows.car[can_train].tolist(), rows.sets[can_train].tolist()) == (
        [1, 0],
        ["seen", "chia"],
    )


def test_pasted_cars_have_exact_boxes_and_lookalikes_none() -> None:
    rng = np.random.default_rng(0)
    flat = np.full((400, 400, 3), 120, np.uint8)
    ground = Ground(
        TrainImage(
            "cannes",
            flat,
            boxes=np.zeros((0, 5)),
            ignore=np.zeros((0, 4, 2)),
            clutter=np.zeros((0, 2)),
        ),
        0.1,
    )
    drawn = [pasted(rng, ground, Fleet(4.6, rng, "mixed")) for _ in range(60)]
    chips = [chip for chip in drawn if chip is not None]
    cars = [chip for chip in chips if chip.car]
    assert 15 < len(cars) < 45
    assert all(chip.box is None for chip in chips if not chip.car)
    for chip in cars[:12]:
        assert chip.box is not None
        x, y, length, width, turn = chip.box.astype(np.float64)
        box = np.array([72 + 36 * x, 72 + 36 * y, 36 * np.exp(length), 36 * np.exp(width), turn])
        inside = _rectangle(STORED_PX, box)[:, :, 0] > 127
        # The car differs from the flat ground.
        assert np.abs(chip.chip.astype(float) - 120).mean(axis=2)[inside].mean() > 8


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of the TorchScript exporter
def test_the_file_answers_as_the_network_in_half_of_its_space(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = ChipNet().eval()
    export(network, tmp_path / "chips.onnx")
    numbers = sum(values.numel() for values in network.parameters())
    assert (tmp_path / "chips.onnx").stat().st_size < 2.4 * numbers
    _add_empty_head(tmp_path / "chips.onnx", n_features=_n_features(network))
    chips = np.random.default_rng(0).integers(0, 255, (3, CHIP_ROWS, CHIP_COLUMNS, 3), np.uint8)
    exported = ChipNetwork(tmp_path / "chips.onnx", runtime=Runtime(threads=1))
    answers = exported.answers(chips, views=1)
    with torch.no_grad():
        expected = network(torch.from_numpy(chips.transpose(0, 3, 1, 2).copy()).float() / 255)
    np.testing.assert_allclose(answers.edges, expected.edges.numpy(), atol=2e-3)
    np.testing.assert_allclose(answers.logit, expected.logit.numpy(), atol=2e-2)


def _n_features(network: ChipNet) -> int:
    """Count the features that the heads read."""
    dense = next(network.seen[0].children())
    assert isinstance(dense, torch.nn.Linear)
    return dense.in_features


def _add_empty_head(path: Path, n_features: int) -> None:
    """Add the output of the head for drawn things, without which the file is not a chip network."""
    head = {
        "hidden_weight": np.zeros((1, n_features), np.float32),
        "hidden_bias": np.zeros(1, np.float32),
        "out_weight": np.zeros((1, 1), np.float32),
        "out_bias": np.zeros(1, np.float32),
    }
    model = onnx.load(path)
    with_head(model, head, offset=0.0)
    onnx.save(model, path)


def test_training_begins_from_the_bundled_file() -> None:
    path = auxiliary_model(resolve_model(), "chips")
    assert path is not None
    network = ChipNet()
    chips = np.random.default_rng(0).integers(0, 255, (16, CHIP_ROWS, CHIP_COLUMNS, 3), np.uint8)
    planes = torch.from_numpy(chips.transpose(0, 3, 1, 2).copy()).float() / 255
    load_exported(network, path, planes, without=(HEAD_PREFIX,))
    with torch.no_grad():
        outputs = network.eval()(planes)
    answers = ChipNetwork(path, runtime=Runtime(threads=1)).answers(chips, views=1)
    np.testing.assert_allclose(outputs.edges.numpy(), answers.edges, atol=1e-4)
    np.testing.assert_allclose(outputs.logit.numpy(), answers.logit, atol=1e-3)
