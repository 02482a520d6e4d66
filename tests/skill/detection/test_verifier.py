"""The verifier: chips of candidates with their surroundings, and the combined score."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from vehanchor.detection.card import VerifierCard, read_auxiliary_card, read_detector_card
from vehanchor.detection.detections import Objects
from vehanchor.detection.verifier import CHIP_PX, Verifier, Weights, surroundings
from vehanchor.errors import ModelContractError
from vehanchor.models.zoo import bundled_models, resolve_model, verifier_beside

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


def test_outside_the_image_its_border_is_repeated() -> None:
    pixels = np.full((40, 60, 3), 90, np.uint8)
    assert (surroundings(pixels, [(0.5, 39.5, 80.0, 30.0, 1.0)]) == 90).all()


def test_chips_are_the_same_cut_alone_or_with_others() -> None:
    rng = np.random.default_rng(3)
    pixels = rng.integers(0, 255, (150, 170, 3), dtype=np.uint8)
    boxes = np.column_stack(
        [rng.uniform(-5, 175, (60, 2)), rng.uniform(8, 70, 60), np.full(60, 9.0), rng.uniform(-1.6, 1.6, 60)]
    )
    assert np.array_equal(surroundings(pixels, boxes), np.concatenate([surroundings(pixels, box) for box in boxes]))
    assert surroundings(pixels, np.zeros((0, 5))).shape == (0, CHIP_PX, CHIP_PX, 3)


def test_weights_make_one_score_of_two_opinions() -> None:
    assert Weights(1.0, 0.0, 0.0).score([0.2, 0.9], [9.0, -9.0]) == pytest.approx([0.2, 0.9])
    rising = Weights(0.5, 0.3, -0.6).score([0.6] * 3, [-4.0, 0.0, 4.0])
    assert (np.diff(rising) > 0).all()
    assert ((rising > 0) & (rising < 1)).all()


def test_a_size_that_fits_the_ground_raises_a_score_and_one_that_does_not_lowers_it() -> None:
    low, same, high = Weights(1.0, 0.0, 0.0, 0.3).score([0.6] * 3, [0.0] * 3, [-2.0, 0.0, 2.0])
    assert low < same < high
    assert same == pytest.approx(0.6)
    assert Weights(1.0, 0.0, 0.0).score([0.6], [0.0], [2.0]) == pytest.approx([0.6])  # not stated: it has no say


def test_the_card_takes_the_scores_of_the_verifier() -> None:
    verifier = read_auxiliary_card(VerifierCard, Path("verifier.onnx"), "b" * 64, _METADATA)
    own = {"vehanchor.name": "vehicles", "vehanchor.min_score": "0.4"}
    card = read_detector_card(Path("vehicles.onnx"), "a" * 64, own, verifier=verifier)
    assert (card.min_score, card.verifier_sha256) == (0.5, "b" * 64)
    assert read_detector_card(Path("vehicles.onnx"), "a" * 64, own).min_score == 0.4
    with pytest.raises(ModelContractError, match=r"verifier .* 'vehicles', and this is 'mine'"):
        read_detector_card(Path("mine.onnx"), "a" * 64, {"vehanchor.name": "mine"}, verifier=verifier)


def test_the_weight_of_the_size_may_be_stated() -> None:
    stated = read_auxiliary_card(VerifierCard, Path("l.onnx"), "b" * 64, _METADATA | {"vehanchor.weights": "1,2,3,4"})
    assert stated.weights == (1, 2, 3, 4)


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
