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
from research.scenes.sprites import Sun
from research.training.car_verifier.lookalikes import LOOKALIKES
from research.training.car_verifier.mine import chia_images, cropped, overlaps, relative, rows_of, type_of
from research.training.car_verifier.network import CarVerifierNet
from research.training.car_verifier.paste import Ground, pasted
from research.training.car_verifier.store import STORED_LENGTH_PX, STORED_PX, ChipStore, Rows, read_store
from research.training.car_verifier.stream import Batch, ChipStream, cut, draw_move, moved_box
from research.training.car_verifier.train import export, losses
from research.training.detector.data import TrainImage
from research.training.warm_start import load_exported
from vehanchor.detection.boxes import box_corners
from vehanchor.detection.car_verifier import CHIP_LENGTH_PX, CHIP_PX, VEHICLE_TYPES

pytestmark = pytest.mark.slow


def _rectangle(side: int, box: NDArray[np.float64]) -> NDArray[np.uint8]:
    image = np.zeros((side, side, 3), np.uint8)
    corners = np.round((box_corners(box[None])[0] - 0.5) * 256).astype(np.int32)
    cv2.fillPoly(image, [corners], (255, 255, 255), cv2.LINE_AA, 8)
    return image


def _centre(chip: NDArray[np.uint8]) -> NDArray[np.float64]:
    lit = chip[:, :, 0].astype(np.float64)
    at = np.arange(len(lit)) + 0.5
    return np.array([(lit.sum(axis=0) @ at), (lit.sum(axis=1) @ at)]) / lit.sum()


def _rows(count: int) -> Rows:
    nothing = np.full(count, np.nan, np.float32)
    return Rows(
        (np.arange(count) % 2).astype(np.int8), np.full(count, -1, np.int8), np.zeros((count, 5), np.float32),
        np.ones(count, np.float32), nothing, np.full(count, 40, np.float32), nothing, nothing,
        np.full(count, "some"), np.full(count, "file"),
    )  # fmt: skip


def test_a_relative_box_gives_the_true_box_back() -> None:
    candidate, truth = np.array([[100.0, 80.0, 30.0, 13.0, 0.4]]), np.array([[103.0, 78.0, 36.0, 15.0, 0.6]])
    along, across, length, width, turn = relative(candidate, truth)[0].astype(np.float64)
    cos, sin = np.cos(0.4), np.sin(0.4)
    middle = candidate[0, :2] + 30.0 * np.array([cos * along - sin * across, sin * along + cos * across])
    np.testing.assert_allclose(middle, truth[0, :2], atol=1e-5)
    np.testing.assert_allclose([30 * np.exp(length), 30 * np.exp(width), 0.4 + turn], truth[0, 2:], rtol=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_a_moved_box_stays_on_the_thing_that_the_chip_shows(seed: int) -> None:
    box = np.array([0.05, -0.08, np.log(0.9), np.log(0.4), 0.1])
    middle = STORED_PX / 2 + box[:2] * STORED_LENGTH_PX
    drawn = np.array([*middle, np.exp(box[2]) * STORED_LENGTH_PX, np.exp(box[3]) * STORED_LENGTH_PX, box[4]])
    move = draw_move(np.random.default_rng(seed))
    chip = cut(_rectangle(STORED_PX, drawn), move)
    seen = moved_box(box, move).astype(np.float64)
    np.testing.assert_allclose(CHIP_PX / 2 + seen[:2] * CHIP_LENGTH_PX, _centre(chip), atol=0.5)
    sizes = np.exp(seen[2:4]) * CHIP_LENGTH_PX
    again = _rectangle(CHIP_PX, np.array([*(CHIP_PX / 2 + seen[:2] * CHIP_LENGTH_PX), *sizes, seen[4]]))
    both, either = np.minimum(chip, again).sum(dtype=float), np.maximum(chip, again).sum(dtype=float)
    assert both / either > 0.85


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


def test_what_lies_on_an_ignored_place_teaches_nothing() -> None:
    ignore = box_corners(np.array([[60.0, 60.0, 30.0, 12.0, 0.0]]))
    sample = TrainImage("cannes", np.zeros((120, 120, 3), np.uint8), np.zeros((0, 5)), ignore, np.zeros((0, 2)))
    boxes = np.array([[60.0, 60.0, 20.0, 9.0, 0.0], [20.0, 20.0, 20.0, 9.0, 0.0]])
    _, known = rows_of(sample, "a.jpg", boxes, np.ones(2), np.ones(2))
    assert known.tolist() == [False, True]


@pytest.mark.parametrize("seed", range(5))
def test_a_part_of_an_image_keeps_its_cars_in_place_and_ignores_those_it_cuts(seed: int) -> None:
    image = np.zeros((400, 900, 3), np.uint8)
    boxes = np.array([[60.0 + 30 * k, 200.0, 24.0, 10.0, 0.0] for k in range(27)])
    for box in boxes:
        image[int(box[1]) - 2 : int(box[1]) + 2, int(box[0]) - 2 : int(box[0]) + 2] = 255
    sample = TrainImage("jekhor", image, boxes, np.zeros((0, 4, 2)), np.zeros((0, 2)))
    part = cropped(np.random.default_rng(seed), sample, 300)
    assert part.image.shape[:2] == (300, 300)
    assert len(part.boxes) >= 8
    for x, y, *_ in part.boxes:
        assert (part.image[int(y) - 2 : int(y) + 2, int(x) - 2 : int(x) + 2] == 255).all()
    whole = box_corners(part.boxes)
    assert ((whole >= 0) & (whole <= 300)).all()
    assert len(part.ignore) <= 2


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


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_training_goes_on_from_an_exported_file(tmp_path: Path) -> None:
    torch.manual_seed(0)
    trained, begun, chips = CarVerifierNet().eval(), CarVerifierNet(), torch.rand(8, 3, CHIP_PX, CHIP_PX)
    export(trained, tmp_path / "net.onnx")
    load_exported(begun, tmp_path / "net.onnx", chips)
    with torch.no_grad():
        for ours, theirs in zip(begun.eval()(chips), trained(chips), strict=True):
            torch.testing.assert_close(ours, theirs, atol=1e-3, rtol=1e-3)


def test_overlaps_find_the_label_of_each_box() -> None:
    labels = np.array([[10.0, 10.0, 8.0, 4.0, 0.0], [50.0, 50.0, 8.0, 4.0, 0.0]])
    iou, which = overlaps(labels[::-1].copy(), labels)
    np.testing.assert_allclose(iou, 1, atol=1e-6)
    assert which.tolist() == [1, 0]


@pytest.mark.parametrize(("body", "length", "kind"), [
    ("crew cab:crates 3", 5.5, "pickup"), ("kei truck:empty 0", 3.4, "kei"), ("hatchback", 3.8, "small"),
    ("sedan:rack 1", 4.8, "saloon"), ("semitrailer", 15.0, "lorry"), ("caravan", 7.0, "trailer"),
])  # fmt: skip
def test_rendered_bodies_have_types(body: str, length: float, kind: str) -> None:
    assert VEHICLE_TYPES[type_of(body, length)] == kind


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


@pytest.mark.parametrize("thing", LOOKALIKES)
def test_lookalikes_are_of_a_cars_order_of_size_and_finite(thing: object) -> None:
    canvas = np.full((288, 288, 3), 120, np.float32)
    length, width = thing(np.random.default_rng(1), canvas, 16.0, Sun(0.3, 0.8))  # type: ignore[operator]
    assert 1 < length < 10
    assert 0.3 < width < 7
    assert np.isfinite(canvas).all()
    assert (canvas != 120).any()


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


def test_a_store_cut_off_is_refused(tmp_path: Path) -> None:
    store = ChipStore()
    store.add(np.zeros((2, STORED_PX, STORED_PX, 3), np.uint8), _rows(2))
    store.save(tmp_path)
    np.save(tmp_path / "chips.npy", np.zeros((1, STORED_PX, STORED_PX, 3), np.uint8))
    with pytest.raises(ValueError, match="1 chips, but 2 rows"):
        read_store(tmp_path)


def test_losses_are_silent_where_nobody_knows() -> None:
    network = CarVerifierNet()
    nothing = Batch(
        torch.zeros(2, 3, CHIP_PX, CHIP_PX, dtype=torch.uint8), torch.tensor([0.0, 1.0]), torch.tensor([-1, -1]),
        torch.zeros(2, 5), torch.zeros(2), torch.full((2,), float("nan")),
    )  # fmt: skip
    found = losses(network, nothing, torch.device("cpu"))
    assert found["car"] > 0
    assert found["type"] == found["box"] == found["length"] == 0


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
