"""The verifier: chips of candidates with their surroundings, and the combined score."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from research.scenes import render_scene
from tests.models import blank_image, paint_vehicles, write_car_verifier, write_detector, write_fleet_network
from vehanchor.detection.appearance import FleetLengths
from vehanchor.detection.car_verifier import (
    CHIP_LENGTH_PX,
    CarVerifier,
    VerifiedVehicles,
    candidate_chips,
    corrected_boxes,
)
from vehanchor.detection.card import VerifierCard, read_auxiliary_card, read_detector_card
from vehanchor.detection.detections import Detections, Objects
from vehanchor.detection.detector import Detector, load_detector
from vehanchor.detection.networks import networks_sha256
from vehanchor.detection.search import search
from vehanchor.detection.verifier import CHIP_PX, Verifier, surroundings
from vehanchor.errors import ModelContractError, ModelNotFoundError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import bundled_models, car_verifier_beside, resolve_model, verifier_beside
from vehanchor.options import Search

_METADATA = {
    "vehanchor.detector": "vehicles",
    "vehanchor.weights": "0.5,0.3,-0.6",
    "vehanchor.least_score": "0.15",
    "vehanchor.min_score": "0.5",
}


@pytest.mark.parametrize("length", [9.0, 20.0, 70.0])
@pytest.mark.parametrize("angle", [0.0, 0.7, 2.4])
def test_a_chip_lies_along_its_candidate(length: float, angle: float) -> None:
    rows, columns = np.mgrid[0:300, 0:300] + 0.5
    along = (columns - 150) * np.cos(angle) + (rows - 140) * np.sin(angle)
    ramp = np.clip(128 + 100 * along / length, 0, 255).astype(np.uint8)
    (chip,) = surroundings(np.repeat(ramp[:, :, None], 3, axis=2), [(150.0, 140.0, length, 0.4 * length, angle)])
    assert chip.shape == (CHIP_PX, CHIP_PX, 3)
    middle = chip[CHIP_PX // 2, :, 0].astype(float)
    assert middle[14] == pytest.approx(78, abs=8)
    assert middle[34] == pytest.approx(178, abs=8)
    assert np.ptp(chip[8:40, CHIP_PX // 2, 0].astype(int)) < 12


def test_the_card_takes_the_scores_of_the_verifier() -> None:
    verifier = read_auxiliary_card(VerifierCard, Path("verifier.onnx"), "b" * 64, _METADATA)
    own = {"vehanchor.name": "vehicles", "vehanchor.min_score": "0.4"}
    card = read_detector_card(Path("vehicles.onnx"), "a" * 64, own, verifier=verifier)
    assert (card.min_score, card.verifier_sha256) == (0.5, "b" * 64)
    assert read_detector_card(Path("vehicles.onnx"), "a" * 64, own).min_score == 0.4
    with pytest.raises(ModelContractError, match=r"verifier .* 'vehicles', and this is 'mine'"):
        read_detector_card(Path("mine.onnx"), "a" * 64, {"vehanchor.name": "mine"}, verifier=verifier)


@pytest.mark.parametrize(
    ("key", "text"),
    [("weights", "1,2"), ("weights", "-1,1,0"), ("weights", "1,1,0,-1"), ("min_score", "2"), ("detector", None)],
)
def test_a_card_without_meaning_is_refused(key: str, text: str | None) -> None:
    metadata = {name: value for name, value in _METADATA.items() if name != f"vehanchor.{key}"}
    if text is not None:
        metadata[f"vehanchor.{key}"] = text
    with pytest.raises(ModelContractError, match=f"vehanchor.{key}"):
        read_auxiliary_card(VerifierCard, Path("verifier.onnx"), "b" * 64, metadata)


def test_the_bundled_detector_has_one_and_it_is_no_detector() -> None:
    path = verifier_beside(resolve_model())
    assert path is not None
    assert path.stem not in bundled_models()
    verifier = Verifier(path)
    pixels = np.random.default_rng(0).integers(0, 255, (200, 200, 3), dtype=np.uint8)
    boxes = np.column_stack(
        [np.linspace(5, 195, 130), np.full(130, 99.0), np.full(130, 20.0), np.full(130, 9.0), np.zeros(130)]
    )
    judged = verifier.scored(pixels, Objects(boxes, np.full(130, 0.6), np.zeros(130, np.intp)))
    assert len(judged) == 130
    assert judged.scores.max() < 0.6  # noise holds no cars
    assert len(verifier.scored(pixels, Objects.joined())) == 0


def test_another_network_is_refused() -> None:
    with pytest.raises(ModelContractError, match="research/training/verifier"):
        Verifier(resolve_model())


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


def test_another_car_verifier_is_refused(tmp_path: Path) -> None:
    path = write_car_verifier(tmp_path / "m.onnx", outputs=("logit", "box"))
    with pytest.raises(ModelContractError, match=r"has chips, logit, box: expected chips \[n, 3, 96, 96\]"):
        CarVerifier(path)
    with pytest.raises(ModelContractError, match="does not give numbers"):
        _answers(CarVerifier(write_car_verifier(tmp_path / "m.onnx", gain=np.nan)), _square(9, 9), np.ones((1, 5)))
    with pytest.raises(ModelNotFoundError):
        CarVerifier(tmp_path / "none.onnx")


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


@pytest.mark.slow
def test_a_search_verifies_fewer_candidates_a_tile_once_it_has_found_many_vehicles(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    image = render_scene(0.15, width_px=1024, height_px=1024, seed=5, layout="parking").image
    counts: list[int] = []
    scored = Verifier.scored

    def counted(self: Verifier, pixels: NDArray[np.uint8], found: Objects, *, size_odds: Any = 0.0) -> Objects:
        counts.append(len(found))
        return scored(self, pixels, found, size_odds=size_odds)

    monkeypatch.setattr(Verifier, "scored", counted)
    monkeypatch.setattr("vehanchor.detection.search.ANYTIME_PIXELS", 1)
    for name, value in (("_MOST_VERIFIED", 60), ("_LEAST_VERIFIED", 10)):
        monkeypatch.setattr(f"vehanchor.detection.search.{name}", value)
    verified, found = {}, {}
    for many in (10**6, 30):
        monkeypatch.setattr("vehanchor.detection.search._MANY_VEHICLES", many)
        with open_raster(image) as raster:
            found[many] = search(raster, load_detector(resolve_model()), Search(tile_px=512, search_scales=False))
        verified[many], counts = counts, []
    first = verified[30].index(min(verified[30]))
    assert verified[30][0] == verified[10**6][0] >= 60
    assert max(verified[30][first:]) < 60 <= max(verified[10**6][first:])
    assert found[30].n_skipped > found[10**6].n_skipped > 0
    lengths = [np.median(each.boxes[:, 2]) for each in found.values()]
    assert lengths[0] == pytest.approx(lengths[1], rel=0.05)
