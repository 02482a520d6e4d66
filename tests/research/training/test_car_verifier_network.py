"""The car verifier: mirrored chips whose answers agree, and corrections applied to boxes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import pytest
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper

from research.training.car_verifier.verifier import CHIP_LENGTH_PX, CHIP_PX, VEHICLE_TYPES, CarVerifier, corrected_boxes
from tests.conftest import ROOT
from vehanchor.detection.boxes import box_corners
from vehanchor.errors import ModelContractError, ModelNotFoundError
from vehanchor.models.runtime import Runtime
from vehanchor_scenes import render_scene

_PATCH_PX = 8  # side of a bright square on a chip
_PARTS = {"logit": 1, "types": len(VEHICLE_TYPES), "box": 5, "log_length_m": 1}


def _write_network(
    path: Path, *, outputs: tuple[str, ...] = tuple(_PARTS), bias: float = 0.0, fusion: str = "2,0.5,-0.25"
) -> Path:
    """A linear network: its logit is the chip's mean, its box correction where a square of 8 px lies on black."""
    at = (np.arange(CHIP_PX) + 0.5 - CHIP_PX / 2) / CHIP_LENGTH_PX / _PATCH_PX**2
    weight = np.zeros((3, CHIP_PX, CHIP_PX, sum(_PARTS.values())), np.float32)
    weight[..., 0] = 1 / (3 * CHIP_PX**2)
    weight[0, :, :, 1] = 1.0  # the first type, where there is red
    weight[0, :, :, 11], weight[0, :, :, 12] = at[None, :], at[:, None]
    offset = np.full(weight.shape[-1], bias, np.float32)
    sizes = np.array(list(_PARTS.values()), np.int64)
    nodes = [
        helper.make_node("Flatten", ["chips"], ["flat"]),
        helper.make_node("Gemm", ["flat", "weight", "offset"], ["all"]),
        helper.make_node("Split", ["all", "sizes"], ["logits", "types", "box", "lengths"], axis=1),
        helper.make_node("Squeeze", ["logits", "axis"], ["logit"]),
        helper.make_node("Squeeze", ["lengths", "axis"], ["log_length_m"]),
    ]
    values: dict[str, NDArray[Any]] = {
        "weight": weight.reshape(-1, weight.shape[-1]), "offset": offset, "sizes": sizes, "axis": np.array([1]),
    }  # fmt: skip
    shapes: dict[str, list[str | int | None]] = {
        "logit": ["n"],
        "types": ["n", 10],
        "box": ["n", 5],
        "log_length_m": ["n"],
    }
    graph = helper.make_graph(
        nodes, "verifier",
        [helper.make_tensor_value_info("chips", TensorProto.FLOAT, ["n", 3, CHIP_PX, CHIP_PX])],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shapes[name]) for name in outputs],
        [numpy_helper.from_array(value, name) for name, value in values.items()],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    helper.set_model_props(model, {"vehanchor.fusion": fusion})
    onnx.save(model, path)
    return path


@pytest.fixture(scope="module")
def verifier(tmp_path_factory: pytest.TempPathFactory) -> CarVerifier:
    return CarVerifier(_write_network(tmp_path_factory.mktemp("models") / "verifier.onnx"), runtime=Runtime(threads=1))


def _square(x: int, y: int) -> NDArray[np.uint8]:
    pixels = np.zeros((200, 220, 3), np.uint8)
    pixels[y - 4 : y + 4, x - 4 : x + 4, 0] = 255
    return pixels


@pytest.mark.parametrize("angle", [0.0, 0.9, 2.2])
def test_mirrored_chips_agree_on_where_the_vehicle_lies(verifier: CarVerifier, angle: float) -> None:
    candidate = np.array([[100.0, 90.0, CHIP_LENGTH_PX, 14.0, angle]])
    answers = verifier.verify(_square(106, 86), candidate)
    (x, y, *_) = corrected_boxes(candidate, answers.box * (1, 1, 0, 0, 1))[0]
    assert (x, y) == pytest.approx((106, 86), abs=0.3)
    assert answers.box[0, 4] == pytest.approx(0, abs=1e-6)


def test_each_candidate_has_an_answer_and_its_types_are_probabilities(verifier: CarVerifier) -> None:
    boxes = np.array([[109.0, 84.0, 32.0, 14.0, 0.2], [20.0, 20.0, 32.0, 14.0, 0.2]])
    answers = verifier.verify(_square(109, 84), boxes)
    np.testing.assert_allclose(answers.types.sum(axis=1), 1)
    assert answers.types[0].argmax() == 0
    assert answers.logit[0] > answers.logit[1] == pytest.approx(0, abs=1e-6)
    assert answers.log_length_m.shape == (2,)


def test_no_candidates_have_no_answers(verifier: CarVerifier) -> None:
    answers = verifier.verify(_square(50, 50), np.zeros((0, 5)))
    assert [len(each) for each in answers] == [0, 0, 0, 0]
    assert answers.types.shape == (0, len(VEHICLE_TYPES))


def test_a_correction_brings_a_box_onto_the_vehicle() -> None:
    truth = np.array([[52.0, 41.0, 33.0, 13.0, 0.7]])
    candidate = np.array([[50.0, 40.0, 30.0, 12.0, 0.6]])
    along = 2 * np.cos(0.6) + np.sin(0.6)
    across = np.cos(0.6) - 2 * np.sin(0.6)
    correction = np.array([[along / 30, across / 30, np.log(33 / 30), np.log(13 / 30), 0.1]])
    np.testing.assert_allclose(box_corners(corrected_boxes(candidate, correction)), box_corners(truth), atol=1e-9)


def test_a_correction_beyond_what_training_shows_is_cut_short() -> None:
    candidate = np.array([[50.0, 40.0, 30.0, 12.0, 0.0]])
    (x, _, length, width, _) = corrected_boxes(candidate, np.array([[9.0, 0, 2.0, 2.0, 0]]))[0]
    assert x == pytest.approx(50 + 0.3 * 30)
    assert length == pytest.approx(30 * np.exp(0.35))
    assert width <= length


def test_a_file_with_other_outputs_is_refused(tmp_path: Path) -> None:
    path = _write_network(tmp_path / "other.onnx", outputs=("logit", "box"))
    with pytest.raises(ModelContractError, match=r"has chips, logit, box: expected chips \[n, 3, 96, 96\]"):
        CarVerifier(path)


@pytest.mark.parametrize("stated", ["", "1,2", "one,two,three"])
def test_a_file_without_a_fusion_is_refused(tmp_path: Path, stated: str) -> None:
    with pytest.raises(ModelContractError, match="is not three numbers"):
        CarVerifier(_write_network(tmp_path / "other.onnx", fusion=stated))


def test_scores_and_logits_become_log_odds(verifier: CarVerifier) -> None:
    assert verifier.fusion == (2.0, 0.5, -0.25)
    odds = verifier.fusion.log_odds(np.array([0.5, 0.5, 0.8, 1.0]), np.array([0.0, 3.0, 0.0, 0.0]))
    assert odds[:3] == pytest.approx([-0.25, 1.25, 2 * np.log(4) - 0.25])
    assert np.isfinite(odds[3])


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ModelNotFoundError):
        CarVerifier(tmp_path / "none.onnx")


def test_answers_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    broken = CarVerifier(_write_network(tmp_path / "broken.onnx", bias=float("nan")))
    with pytest.raises(ModelContractError, match="does not answer in finite numbers"):
        broken.verify(_square(50, 50), np.array([[50.0, 50.0, 30.0, 12.0, 0.0]]))


def test_a_larger_view_of_the_same_scene_gets_the_same_answer(verifier: CarVerifier) -> None:
    pixels, box = _square(109, 84), np.array([[105.0, 88.0, 32.0, 14.0, 0.4]])
    larger = np.asarray(cv2.resize(pixels, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC), np.uint8)
    small, large = verifier.verify(pixels, box), verifier.verify(larger, box * (2, 2, 2, 2, 1))
    np.testing.assert_allclose(large.box[0, :2], small.box[0, :2], atol=0.02)


def test_the_candidate_file_prefers_rendered_cars_to_boxes_of_twice_their_size() -> None:
    file = ROOT / "research" / "training" / "car_verifier" / "car-verifier.onnx"
    candidate = CarVerifier(file, runtime=Runtime(threads=1))
    scene = render_scene(0.15, width_px=512, height_px=512, seed=4, layout="urban")
    cars = [car for car in scene.vehicles if car.kind == "small-vehicle" and not car.difficult]
    boxes = np.array([[car.x_px, car.y_px, car.length_px, car.width_px, car.angle_rad] for car in cars])
    fitting, large = candidate.verify(scene.image, boxes), candidate.verify(scene.image, boxes * (1, 1, 2, 2, 1))
    assert len(boxes) > 10
    assert np.median(fitting.logit) > 0 > np.median(large.logit)
