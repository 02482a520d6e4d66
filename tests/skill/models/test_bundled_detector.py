"""The shipped model, end to end: on rendered scenes of exactly known scale and on real photographs."""

from __future__ import annotations

import hashlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.conftest import ROOT
from vehanchor import estimate_gsd
from vehanchor.detection.detector import Detector, load_detector
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import (
    DEFAULT_DETECTOR,
    car_verifier_beside,
    fleet_beside,
    resolve_model,
    verifier_beside,
)
from vehanchor.records import GsdEstimate
from vehanchor.scale.defaults import REGIONS
from vehanchor_evaluation.gsd import run_trials, summarise
from vehanchor_evaluation.table import survey_table

_FLEET_M = 4.6
_GSD = 0.12


@pytest.fixture(scope="module")
def detector() -> Detector:
    return Detector(resolve_model(), runtime=Runtime(threads=2))


def _estimate(image: np.ndarray, detector: Detector) -> GsdEstimate:
    return estimate_gsd(image, detector=detector, reference_length_m=_FLEET_M)


@pytest.fixture(scope="module")
def estimate(car_park: np.ndarray, detector: Detector) -> GsdEstimate:
    return _estimate(car_park, detector)


def test_a_rendered_scene_gives_its_scale(estimate: GsdEstimate) -> None:
    assert estimate.status == "ok"
    assert estimate.gsd_m_per_px == pytest.approx(_GSD, rel=0.10)
    assert (estimate.n_vehicles or 0) > 40  # half of them


def test_a_quarter_turn_changes_the_scale_by_less_than_3_percent(
    car_park: np.ndarray, estimate: GsdEstimate, detector: Detector
) -> None:
    upright = estimate.gsd_m_per_px
    turned = _estimate(np.ascontiguousarray(np.rot90(car_park)), detector).gsd_m_per_px
    assert turned == pytest.approx(upright, rel=0.03)


@pytest.mark.parametrize("factor", [0.75, 1.25])
def test_resampling_scales_the_answer_within_3_percent(
    car_park: np.ndarray, estimate: GsdEstimate, detector: Detector, factor: float
) -> None:
    way = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    resampled = np.asarray(cv2.resize(car_park, None, fx=factor, fy=factor, interpolation=way), dtype=np.uint8)
    assert estimate.gsd_m_per_px is not None
    after = _estimate(resampled, detector).gsd_m_per_px
    assert after == pytest.approx(estimate.gsd_m_per_px / factor, rel=0.03)


def test_a_scene_without_vehicles_never_gets_a_confident_answer(detector: Detector) -> None:
    assert estimate_gsd(ROOT / "examples/scenes/no_cars.jpg", detector=detector).status != "ok"


def test_one_and_two_threads_give_the_same_bytes(car_park: np.ndarray) -> None:
    records = {
        estimate_gsd(car_park[:400], detector=str(resolve_model()), threads=threads).model_dump_json()
        for threads in (1, 2, 2)
    }
    assert len(records) == 1


def test_the_shipped_file_is_the_one_that_was_measured() -> None:
    path = resolve_model(DEFAULT_DETECTOR)
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    assert sha256 in (ROOT / "research/results/scale.json").read_text(encoding="utf-8")
    assert sha256 in path.with_suffix(".md").read_text(encoding="utf-8")
    assert path.stat().st_size <= 8_000_000
    fleet, car_verifier = fleet_beside(path), car_verifier_beside(path)
    assert fleet is not None
    assert car_verifier is not None
    for file, card in ((fleet, path), (car_verifier, car_verifier)):
        sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
        assert sha256 in card.with_suffix(".md").read_text(encoding="utf-8")


def test_the_file_in_eight_bits_is_the_one_that_was_measured() -> None:
    path = resolve_model(None, "int8")
    verifier = verifier_beside(path)
    assert verifier is not None
    card = path.with_suffix(".md").read_text(encoding="utf-8")
    results = (ROOT / "research/results/detection.json").read_text(encoding="utf-8")
    for file in (path, verifier):
        sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
        assert sha256 in results
        assert sha256 in card
    assert path.stat().st_size + verifier.stat().st_size <= 2_500_000


def test_eight_bits_say_nearly_what_float32_says_and_the_record_names_them(
    car_park: np.ndarray, detector: Detector
) -> None:
    image = np.ascontiguousarray(car_park[:512, :512])
    plain = estimate_gsd(image, detector=detector)
    small, again = (estimate_gsd(image, detector="vehicles-int8", threads=threads) for threads in (1, 2))
    assert small == again
    assert (plain.model, small.model) == ("vehicles", "vehicles-int8")
    assert small.details.model_sha256 != plain.details.model_sha256
    assert small.gsd_m_per_px == pytest.approx(plain.gsd_m_per_px, rel=0.02)
    assert small.confidence == pytest.approx(plain.confidence, abs=0.1)
    cards = detector.card, load_detector(resolve_model("vehicles-int8")).card
    assert cards[1].quantised_from == cards[0].name
    assert cards[1].fleet_sha256 == cards[0].fleet_sha256
    assert cards[1].verifier_sha256 not in (None, cards[0].verifier_sha256)


def test_the_shipped_file_carries_its_calibration(detector: Detector) -> None:
    card = detector.card
    assert card.name == DEFAULT_DETECTOR
    assert 4.0 < card.reference_length_m < 5.2
    assert set(card.region_lengths_m) == set(REGIONS)
    assert card.region_lengths_m["europe"] < card.reference_length_m < card.region_lengths_m["north_america"]
    assert card.length_range_px == (9.0, 64.0)
    assert card.licence == "Apache-2.0"


@pytest.mark.data
@pytest.mark.slow
def test_real_photographs_of_known_scale(real_data: Path, detector: Detector) -> None:
    images = [
        image
        for image in survey_table(real_data / "gsd" / "table.csv").images
        if image.split == "val" and (image.labelled_vehicles or 0) >= 5
    ]
    summary = summarise(run_trials(images[::3], detector))  # research/benchmarks/detector.py takes all
    assert summary.images == 35
    assert summary.median <= 0.08
    assert summary.coverage >= 0.9


@pytest.mark.data
@pytest.mark.slow
def test_photographs_without_vehicles_rarely_get_a_confident_answer(real_data: Path, detector: Detector) -> None:
    images = [i for i in survey_table(real_data / "gsd" / "table.csv").images if i.set == "empty" and i.split == "val"]
    confident = [t for t in run_trials(images, detector) if t.analysis.estimate.status == "ok"]
    assert len(confident) <= 1
