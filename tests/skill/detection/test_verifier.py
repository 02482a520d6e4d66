"""The verifier: chips of candidates with their surroundings, and the combined score."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from research.scenes import render_scene
from vehanchor.detection.card import VerifierCard, read_card, read_detector_card
from vehanchor.detection.detections import Objects
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
    rows, columns = np.mgrid[0:300, 0:300] + 0.5
    along = (columns - 150) * np.cos(angle) + (rows - 140) * np.sin(angle)
    ramp = np.clip(128 + 100 * along / length, 0, 255).astype(np.uint8)
    (chip,) = surroundings(
        np.repeat(ramp[:, :, None], 3, axis=2), [(150.0, 140.0, length, 0.4 * length, angle)]
    )
    assert chip.shape == (CHIP_PX, CHIP_PX, 3)
    middle = chip[CHIP_PX // 2, :, 0].astype(float)
    assert middle[14] == pytest.approx(78, abs=8)
    assert middle[34] == pytest.approx(178, abs=8)
    assert np.ptp(chip[8:40, CHIP_PX // 2, 0].astype(int)) < 12


def test_the_card_takes_the_scores_of_the_verifier() -> None:
    verifier = read_card(VerifierCard, Path("verifier.onnx"), sha256="b" * 64, metadata=_METADATA)
    own = {"vehanchor.name": "vehicles", "vehanchor.min_score": "0.4"}
    card = read_detector_card(Path("vehicles.onnx"), "a" * 64, own, verifier=verifier)
    assert (card.min_score, card.verifier_sha256) == (0.5, "b" * 64)
    assert read_detector_card(Path("vehicles.onnx"), "a" * 64, own).min_score == 0.4
    with pytest.raises(ModelContractError, match=r"verifier .* 'vehicles', but this is 'mine'"):
        read_detector_card(
            Path("mine.onnx"), "a" * 64, {"vehanchor.name": "mine"}, verifier=verifier
        )


def test_the_bundled_detector_has_one_and_it_is_no_detector() -> None:
    path = auxiliary_model(resolve_model(), "verifier")
    assert path is not None
    assert path.stem not in bundled_models()
    verifier = Verifier(path)
    pixels = np.random.default_rng(0).integers(0, 255, (200, 200, 3), dtype=np.uint8)
    boxes = np.column_stack(
        [
            np.linspace(5, 195, 130),
            np.full(130, 99.0),
            np.full(130, 20.0),
            np.full(130, 9.0),
            np.zeros(130),
        ]
    )
    judged = verifier.scored(pixels, Objects(boxes, np.full(130, 0.6), np.zeros(130, np.intp)))
    assert len(judged) == 130
    assert judged.scores.max() < 0.6  # noise holds no cars
    assert len(verifier.scored(pixels, Objects.joined())) == 0


@pytest.mark.slow
def test_a_search_verifies_fewer_candidates_a_tile_once_it_has_found_many_vehicles(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    image = render_scene(0.15, width_px=1024, height_px=1024, seed=5, layout="parking").image
    counts: list[int] = []
    scored = Verifier.scored

    def counted(
        self: Verifier, pixels: NDArray[np.uint8], found: Objects, *, size_odds: Any = 0.0
    ) -> Objects:
        counts.append(len(found))
        return scored(self, pixels, found, size_odds=size_odds)

    monkeypatch.setattr(Verifier, "scored", counted)
    monkeypatch.setattr("vehanchor.detection.scheduler.ANYTIME_PIXELS", 1)
    for name, value in (("_MAX_VERIFIED", 60), ("_MAX_VERIFIED_OF_MANY", 10)):
        monkeypatch.setattr(f"vehanchor.detection.search.{name}", value)
    verified = {}
    found = {}
    for many in (10**6, 30):
        monkeypatch.setattr("vehanchor.detection.search._MANY_VEHICLES", many)
        with open_raster(image) as raster:
            found[many] = ImageSearch(
                raster, load_detector(resolve_model()), Search(tile_px=512, search_scales=False)
            ).searched()
        verified[many] = counts
        counts = []
    first = verified[30].index(min(verified[30]))
    assert verified[30][0] == verified[10**6][0] >= 60
    assert max(verified[30][first:]) < 60 <= max(verified[10**6][first:])
    assert found[30].n_skipped > found[10**6].n_skipped > 0
    lengths = [np.median(each.boxes[:, 2]) for each in found.values()]
    assert lengths[0] == pytest.approx(lengths[1], rel=0.05)
