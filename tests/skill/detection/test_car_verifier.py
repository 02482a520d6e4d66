"""The car verifier: mirrored chips whose answers agree, corrections applied to boxes, and its part in the search."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from research.scenes import render_scene
from tests.models import blank_image, paint_vehicles, write_car_verifier, write_detector, write_fleet_network
from vehanchor.detection.appearance import FleetLengths
from vehanchor.detection.boxes import box_corners
from vehanchor.detection.car_verifier import CHIP_LENGTH_PX, CarVerifier, candidate_chips, corrected_boxes
from vehanchor.detection.detector import Detector, load_detector
from vehanchor.detection.networks import networks_sha256
from vehanchor.detection.search import search
from vehanchor.errors import ModelContractError, ModelNotFoundError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import car_verifier_beside, resolve_model
from vehanchor.options import Search

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from vehanchor.detection.car_verifier import VerifiedVehicles
    from vehanchor.detection.detections import Detections

_PAINTED = {"vehanchor.length_range_px": "9,64", "vehanchor.search_scales": "1", "vehanchor.min_score": "0.5"}


@pytest.fixture(scope="module")
def verifier(tmp_path_factory: pytest.TempPathFactory) -> CarVerifier:
    return CarVerifier(write_car_verifier(tmp_path_factory.mktemp("models") / "m.onnx"), runtime=Runtime(threads=1))


def _square(x: int, y: int) -> NDArray[np.uint8]:
    pixels = np.zeros((200, 220, 3), np.uint8)
    pixels[y - 4 : y + 4, x - 4 : x + 4, 0] = 255
    return pixels


def _answers(verifier: CarVerifier, pixels: NDArray[np.uint8], boxes: NDArray[np.float64]) -> VerifiedVehicles:
    with open_raster(pixels) as raster:
        return verifier.verify(candidate_chips(raster, boxes))


@pytest.mark.parametrize("angle", [0.0, 0.9, 2.2])
def test_mirrored_chips_agree_on_where_the_vehicle_lies(verifier: CarVerifier, angle: float) -> None:
    candidate = np.array([[100.0, 90.0, CHIP_LENGTH_PX, 14.0, angle]])
    answers = _answers(verifier, _square(106, 86), candidate)
    (x, y, *_) = corrected_boxes(candidate, answers.box * (1, 1, 0, 0, 1))[0]
    assert (x, y) == pytest.approx((106, 86), abs=0.3)
    assert answers.box[0, 4] == pytest.approx(0, abs=1e-6)


def test_each_candidate_has_an_answer_and_its_types_are_probabilities(verifier: CarVerifier) -> None:
    boxes = np.array([[109.0, 84.0, 32.0, 14.0, 0.2], *[[20.0, 20.0, 32.0, 14.0, 0.2]] * 20])
    answers = _answers(verifier, _square(109, 84), boxes)
    np.testing.assert_allclose(answers.types.sum(axis=1), 1)
    assert answers.types[0].argmax() == 0
    assert answers.logit[0] > answers.logit[1] == pytest.approx(0, abs=1e-6)
    assert answers.log_length_m.shape == (21,)


def test_a_correction_brings_a_box_onto_the_vehicle() -> None:
    truth = np.array([[52.0, 41.0, 33.0, 13.0, 0.7]])
    candidate = np.array([[50.0, 40.0, 30.0, 12.0, 0.6]])
    along = 2 * np.cos(0.6) + np.sin(0.6)
    across = np.cos(0.6) - 2 * np.sin(0.6)
    correction = np.array([[along / 30, across / 30, np.log(33 / 30), np.log(13 / 30), 0.1]])
    np.testing.assert_allclose(box_corners(corrected_boxes(candidate, correction)), box_corners(truth), atol=1e-9)


def test_another_network_is_refused(tmp_path: Path) -> None:
    path = write_car_verifier(tmp_path / "m.onnx", outputs=("logit", "box"))
    with pytest.raises(ModelContractError, match=r"has chips, logit, box: expected chips \[n, 3, 96, 96\]"):
        CarVerifier(path)
    with pytest.raises(ModelContractError, match="does not give numbers"):
        _answers(CarVerifier(write_car_verifier(tmp_path / "m.onnx", gain=np.nan)), _square(9, 9), np.ones((1, 5)))
    with pytest.raises(ModelNotFoundError):
        CarVerifier(tmp_path / "none.onnx")


def test_the_car_verifier_of_another_detector_is_refused(tmp_path: Path) -> None:
    detector = write_detector(tmp_path / "m.onnx")
    write_car_verifier(detector, metadata={"vehanchor.detector": "other"})
    with pytest.raises(ModelContractError, match=r"car verifier .* 'other', and this is 'm'"):
        Detector(detector)


def test_a_larger_view_of_the_same_scene_gets_the_same_answer(verifier: CarVerifier) -> None:
    pixels, box = _square(109, 84), np.array([[105.0, 88.0, 32.0, 14.0, 0.4]])
    small = _answers(verifier, pixels, box)
    for factor in (2, 4):  # the second is read in a reduced copy
        larger = np.asarray(cv2.resize(pixels, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC), np.uint8)
        large = _answers(verifier, larger, box * (factor, factor, factor, factor, 1))
        np.testing.assert_allclose(large.box[0, :2], small.box[0, :2], atol=0.02)


def test_the_bundled_one_prefers_rendered_cars_to_boxes_of_twice_their_size() -> None:
    file = car_verifier_beside(resolve_model())
    assert file is not None
    assert file == car_verifier_beside(resolve_model("vehicles-int8"))
    bundled = CarVerifier(file, runtime=Runtime(threads=1))
    scene = render_scene(0.15, width_px=512, height_px=512, seed=4, layout="urban")
    cars = [car for car in scene.vehicles if car.kind == "small-vehicle" and not car.difficult]
    boxes = np.array([[car.x_px, car.y_px, car.length_px, car.width_px, car.angle_rad] for car in cars])
    fitting, large = (_answers(bundled, scene.image, boxes * (1, 1, size, size, 1)) for size in (1, 2))
    assert len(boxes) > 10
    assert np.median(fitting.logit) > 0 > np.median(large.logit)


def _found(detector: Detector, pixels: NDArray[np.uint8], options: Search | None = None) -> Detections:
    with open_raster(pixels) as raster:
        return search(raster, detector, options)


def _scene(n: int, scores: list[float]) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """A dark picture with painted vehicles, every other one on bright ground."""
    pixels = blank_image(60 + 150 * n, 200, 0)
    for k in range(0, n, 2):
        pixels[:, 150 * k : 150 * (k + 1)] = 255
    return pixels, paint_vehicles(pixels, [[80 + 150 * k, 99.5, 40, 20, 0.0] for k in range(n)], scores=scores)


def test_few_vehicles_are_scored_again_and_their_boxes_corrected(tmp_path: Path) -> None:
    path = write_detector(tmp_path / "m.onnx", metadata=_PAINTED)
    write_car_verifier(
        path, gain=8.0, correction=(0, 0, -0.1, np.log(0.4), 0), metadata={"vehanchor.weights": "1,1,-3"}
    )
    write_fleet_network(path, FleetLengths((-1.0, 1.0), (4.0, 5.0), 0.1, 1.0))
    pixels, boxes = _scene(4, [0.3, 0.9, 0.9, 0.1])
    detector = load_detector(path)
    found = _found(detector, pixels)
    assert sorted(found.boxes[:, 0]) == pytest.approx([80, 380], abs=3)  # a weak one on bright ground and a strong one
    assert found.boxes[:, 2] == pytest.approx(40 * np.exp(-0.1), rel=0.01)
    assert found.boxes[:, 3] == pytest.approx(16, rel=0.01)
    assert (np.diff(found.scores) <= 0).all()
    plain = _found(detector, pixels, Search(verify=False))
    assert sorted(plain.boxes[:, 0]) == pytest.approx([230, 380])
    assert plain.boxes[:, 2] == pytest.approx(boxes[1:3, 2])
    assert (found.verified, plain.verified) == (True, False)
    looks = [each.fleet.log_odds[each.boxes[:, 0].argmax()] for each in (found, plain) if each.fleet]
    assert looks[0] == looks[1]  # the appearance is read from the detector's own box


def test_many_vehicles_are_left_as_they_are(tmp_path: Path) -> None:
    path = write_detector(tmp_path / "m.onnx", metadata=_PAINTED)
    pixels, _ = _scene(14, [0.9] * 13 + [0.3])
    plain = _found(load_detector(path), pixels)
    before = networks_sha256(load_detector(path).card)
    write_car_verifier(path, gain=-9.0, correction=(0, 0, -0.1, np.log(0.4), 0))
    with_one = load_detector(path)
    found = _found(with_one, pixels)
    assert len(found.boxes) == 13
    assert not found.verified
    np.testing.assert_array_equal(found.boxes, plain.boxes)
    np.testing.assert_array_equal(found.scores, plain.scores)
    assert networks_sha256(with_one.card) != before
