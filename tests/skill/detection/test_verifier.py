"""The verifier: chips of candidates with their surroundings, and the combined score."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from research.scenes import render_scene
from vehanchor.detection.card import VerifierCard, read_card, read_detector_card
from vehanchor.detection.detections import Detections, Objects
from vehanchor.detection.detector import load_detector
from vehanchor.detection.search import ImageSearch
from vehanchor.detection.verifier import CHIP_PX, Verifier, surroundings
from vehanchor.errors import ModelContractError
from vehanchor.imagery.sources.opening import open_raster
from vehanchor.models.zoo import auxiliary_model, bundled_models, resolve_model
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
    # A ramp of 100 grey levels over the candidate's length.
    rows, columns = np.mgrid[0:300, 0:300] + 0.5
    along = (columns - 150) * np.cos(angle) + (rows - 140) * np.sin(angle)
    ramp = np.clip(128 + 100 * along / length, 0, 255).astype(np.uint8)
    pixels = np.repeat(ramp[:, :, None], 3, axis=2)
    (chip,) = surroundings(pixels, [(150.0, 140.0, length, 0.4 * length, angle)])
    assert chip.shape == (CHIP_PX, CHIP_PX, 3)
    grey = chip[:, :, 0].astype(float)
    along_axis = grey[CHIP_PX // 2]
    across_axis = grey[8:40, CHIP_PX // 2]
    assert along_axis[14] == pytest.approx(78, abs=8)
    assert along_axis[34] == pytest.approx(178, abs=8)
    assert np.ptp(across_axis) < 12


@pytest.fixture
def verifier_card() -> VerifierCard:
    return read_card(VerifierCard, Path("verifier.onnx"), sha256="b" * 64, metadata=_METADATA)


def test_the_least_score_is_that_of_the_verifier(verifier_card: VerifierCard) -> None:
    own = {"vehanchor.name": "vehicles", "vehanchor.min_score": "0.4"}
    path = Path("vehicles.onnx")
    card = read_detector_card(path, "a" * 64, own, verifier=verifier_card)
    assert (card.min_score, card.verifier_sha256) == (0.5, "b" * 64)
    assert read_detector_card(path, "a" * 64, own).min_score == 0.4


def test_the_verifier_of_another_detector_is_refused(verifier_card: VerifierCard) -> None:
    own = {"vehanchor.name": "mine"}
    with pytest.raises(ModelContractError, match=r"verifier .* 'vehicles', but this is 'mine'"):
        read_detector_card(Path("mine.onnx"), "a" * 64, own, verifier=verifier_card)


@pytest.fixture(scope="module")
def bundled_path() -> Path:
    path = auxiliary_model(resolve_model(), "verifier")
    assert path is not None
    return path


def test_the_bundled_verifier_is_not_a_detector(bundled_path: Path) -> None:
    assert bundled_path.stem not in bundled_models()


def test_the_bundled_verifier_finds_no_cars_in_noise(bundled_path: Path) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (200, 200, 3), dtype=np.uint8)
    boxes = np.tile([0.0, 99.0, 20.0, 9.0, 0.0], (130, 1))
    boxes[:, 0] = np.linspace(5, 195, 130)
    candidates = Objects(boxes, np.full(130, 0.6), np.zeros(130, np.intp))
    scored = Verifier(bundled_path).scored(pixels, candidates)
    assert len(scored) == 130
    assert scored.scores.max() < 0.6


def test_no_candidates_have_no_scores(bundled_path: Path) -> None:
    pixels = np.zeros((200, 200, 3), np.uint8)
    assert len(Verifier(bundled_path).scored(pixels, Objects.joined())) == 0


def _searched(many_vehicles: int, monkeypatch: pytest.MonkeyPatch) -> tuple[Detections, list[int]]:
    """Search a car park; return the detections and the number of candidates of each tile."""
    counts: list[int] = []
    scored = Verifier.scored

    def counted(
        self: Verifier, pixels: NDArray[np.uint8], candidates: Objects, *, size_odds: Any = 0.0
    ) -> Objects:
        counts.append(len(candidates))
        return scored(self, pixels, candidates, size_odds=size_odds)

    monkeypatch.setattr(Verifier, "scored", counted)
    monkeypatch.setattr("vehanchor.detection.scheduler.ANYTIME_PIXELS", 1)
    monkeypatch.setattr("vehanchor.detection.search._MAX_VERIFIED", 60)
    monkeypatch.setattr("vehanchor.detection.search._MAX_VERIFIED_OF_MANY", 10)
    monkeypatch.setattr("vehanchor.detection.search._MANY_VEHICLES", many_vehicles)
    scene = render_scene(0.15, width_px=1024, height_px=1024, seed=5, layout="parking")
    with open_raster(scene.image) as raster:
        options = Search(tile_px=512, search_scales=False)
        detections = ImageSearch(raster, load_detector(resolve_model()), options).searched()
    monkeypatch.undo()
    return detections, counts


@pytest.mark.slow
def test_after_many_vehicles_fewer_candidates_of_a_tile_are_verified(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    few, counts_of_few = _searched(10**6, monkeypatch)
    many, counts_of_many = _searched(30, monkeypatch)
    first = counts_of_many.index(min(counts_of_many))
    assert counts_of_many[0] == counts_of_few[0] >= 60
    assert max(counts_of_many[first:]) < 60 <= max(counts_of_few[first:])
    assert many.n_skipped > few.n_skipped > 0
    assert np.median(few.boxes[:, 2]) == pytest.approx(np.median(many.boxes[:, 2]), rel=0.05)
