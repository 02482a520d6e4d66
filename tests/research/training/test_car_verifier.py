"""The training code of the car verifier, where PyTorch is installed (extra ``train``)."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("torch")
pytest.importorskip("onnxruntime")

import onnxruntime
import torch

from research.scenes.fleet import Fleet
from research.training.car_verifier.mine import chia_images, rows_of
from research.training.car_verifier.network import CarVerifierNet
from research.training.car_verifier.paste import Ground, pasted
from research.training.car_verifier.store import STORED_PX, ChipStore, Rows, read_store
from research.training.car_verifier.stream import ChipStream
from research.training.car_verifier.train import export
from research.training.detector.data import TrainImage
from vehanchor.detection.boxes import box_corners
from vehanchor.detection.car_verifier import CHIP_PX, VEHICLE_TYPES

pytestmark = pytest.mark.slow


def _rectangle(side: int, box: NDArray[np.float64]) -> NDArray[np.uint8]:
    image = np.zeros((side, side, 3), np.uint8)
    corners = np.round((box_corners(box[None])[0] - 0.5) * 256).astype(np.int32)
    cv2.fillPoly(image, [corners], (255, 255, 255), cv2.LINE_AA, 8)
    return image


def _rows(count: int) -> Rows:
    nothing = np.full(count, np.nan, np.float32)
    return Rows(
        (np.arange(count) % 2).astype(np.int8), np.full(count, -1, np.int8), np.zeros((count, 5), np.float32),
        np.ones(count, np.float32), nothing, np.full(count, 40, np.float32), nothing, nothing,
        np.full(count, "some"), np.full(count, "file"),
    )  # fmt: skip


def test_boxes_that_fit_are_cars_and_boxes_between_teach_nothing() -> None:
    car = np.array([[60.0, 60.0, 30.0, 12.0, 0.0]])
    sample = TrainImage("estonia", np.zeros((120, 120, 3), np.uint8), car, np.zeros((0, 4, 2)), np.zeros((0, 2)), 22.5)
    beside = car + np.array([0, 18, 0, 0, 0])
    doubtful = car + np.array([12, 0, 0, 0, 0])
    boxes = np.concatenate([car + np.array([1, 0, 0, 0, 0]), beside, doubtful])
    rows, known = rows_of(sample, "a.jpg", boxes, np.full(3, 0.5), np.full(3, 0.5))
    assert rows.car.tolist()[:2] == [1, 0]
    assert known.tolist() == [True, True, False]
    assert rows.log_length_m[0] == pytest.approx(np.log(30 * 4.5 / 22.5), abs=1e-5)
    assert VEHICLE_TYPES[rows.type[1]] == "other"


def test_of_chia_odd_numbers_train_and_their_cars_teach_nothing(tmp_path: Path) -> None:
    crops = tmp_path / "chia" / "crops"
    crops.mkdir(parents=True)
    for number in (16, 17):
        cv2.imwrite(str(crops / f"DJI_00{number}.jpg"), np.full((1280, 1280, 3), 90, np.uint8))
    table = "file,gsd_m_per_px\ncrops/DJI_0016.jpg,0.018\ncrops/DJI_0017.jpg,0.018\n"
    (tmp_path / "chia" / "crops.csv").write_text(table)
    (only,) = chia_images(tmp_path)
    assert only.file == "DJI_0017.jpg"
    assert not len(only.sample.boxes)
    boxes = np.array([[636.6, 540.1, 250.0, 110.0, 0.3], [100.0, 900.0, 110.0, 50.0, 0.3]])  # a car, and ground
    _, known = rows_of(only.sample, only.file, boxes, np.ones(2), np.ones(2))
    assert known.tolist() == [False, True]


def test_pasted_cars_have_exact_boxes_and_lookalikes_none() -> None:
    rng = np.random.default_rng(0)
    flat = np.full((400, 400, 3), 120, np.uint8)
    ground = Ground(TrainImage("cannes", flat, np.zeros((0, 5)), np.zeros((0, 4, 2)), np.zeros((0, 2))), 0.1)
    made = [one for one in (pasted(rng, ground, Fleet(4.6, rng, "mixed")) for _ in range(60)) if one is not None]
    cars = [one for one in made if one.car]
    assert 15 < len(cars) < 45
    assert all(one.box is None for one in made if not one.car)
    for one in cars[:12]:
        assert one.box is not None
        x, y, length, width, turn = one.box.astype(np.float64)
        box = np.array([72 + 36 * x, 72 + 36 * y, 36 * np.exp(length), 36 * np.exp(width), turn])
        inside = _rectangle(STORED_PX, box)[:, :, 0] > 127
        assert np.abs(one.chip.astype(float) - 120).mean(axis=2)[inside].mean() > 8  # something stands there


def test_a_store_is_read_as_it_was_written_and_streamed_alike(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    store = ChipStore()
    chips = rng.integers(0, 255, (6, STORED_PX, STORED_PX, 3)).astype(np.uint8)
    store.add(chips[:4], _rows(4))
    store.add(chips[4:], _rows(2))
    store.save(tmp_path / "train")
    back, rows = read_store(tmp_path / "train")
    np.testing.assert_array_equal(back, chips)
    assert rows.sets.tolist() == ["some"] * 6
    first, again = (ChipStream([tmp_path / "train"], 3)[7] for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first[:4], again[:4], strict=True))


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_the_exported_file_answers_as_the_network(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = CarVerifierNet().eval()
    export(network, tmp_path / "net.onnx")
    chips = torch.rand(3, 3, CHIP_PX, CHIP_PX)
    session = onnxruntime.InferenceSession(tmp_path / "net.onnx", providers=["CPUExecutionProvider"])
    said = session.run(["logit", "types", "box", "log_length_m"], {"chips": chips.numpy()})
    with torch.no_grad():
        for ours, theirs in zip(network(chips), said, strict=True):
            np.testing.assert_allclose(ours.numpy(), theirs, atol=1e-4)
    assert (tmp_path / "net.onnx").stat().st_size < 12e6
