"""The bundled detector, end to end: on rendered scenes of known scale and on real photographs."""

from __future__ import annotations

import hashlib
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from onnx import helper

from tests.conftest import ROOT
from vehanchor import estimate_gsd
from vehanchor.detection.detector import Detector
from vehanchor.detection.detector_errors import DetectorErrors
from vehanchor.models.runtime import Runtime
from vehanchor.models.zoo import (
    BUNDLED_MODELS,
    DEFAULT_DETECTOR,
    resolve_model,
)
from vehanchor.records import GsdEstimate
from vehanchor.scale.countries import REGIONS
from vehanchor_evaluation.gsd import run_trials, summarise
from vehanchor_evaluation.table import survey_table

_FLEET_M = 4.6
_GSD = 0.12
_BUNDLED = resolve_model().parent


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
    assert estimate.n_vehicles is not None
    assert estimate.n_vehicles > 40  # half of them


@pytest.mark.slow
def test_a_quarter_turn_changes_the_scale_by_less_than_3_percent(
    car_park: np.ndarray, estimate: GsdEstimate, detector: Detector
) -> None:
    upright = estimate.gsd_m_per_px
    turned = _estimate(np.ascontiguousarray(np.rot90(car_park)), detector).gsd_m_per_px
    assert turned == pytest.approx(upright, rel=0.03)


@pytest.mark.parametrize("factor", [0.75, pytest.param(1.25, marks=pytest.mark.slow)])
def test_resampling_scales_the_answer_within_3_percent(
    car_park: np.ndarray, estimate: GsdEstimate, detector: Detector, factor: float
) -> None:
    interpolation = cv2.INTER_AREA if factor < 1 else cv2.INTER_CUBIC
    resized = cv2.resize(car_park, None, fx=factor, fy=factor, interpolation=interpolation)
    resampled = np.asarray(resized, dtype=np.uint8)
    assert estimate.gsd_m_per_px is not None
    after = _estimate(resampled, detector).gsd_m_per_px
    assert after == pytest.approx(estimate.gsd_m_per_px / factor, rel=0.03)


def test_an_export_of_ultralytics_measures_a_car_park(tmp_path: Path) -> None:
    """It has neither our metadata nor auxiliary models nor a file of its errors."""
    model = onnx.load(str(resolve_model()))
    official = {entry.key: entry.value for entry in model.metadata_props}
    del model.metadata_props[:]
    helper.set_model_props(
        model, {key: official[key] for key in ("task", "stride", "imgsz", "names")}
    )
    path = tmp_path / "yolo11n-obb.onnx"
    onnx.save(model, str(path))
    stranger = Detector(path)
    assert (stranger.verifier, stranger.chips, stranger.card.votes) == (None, None, None)
    assert stranger.card.errors == DetectorErrors()
    assert estimate_gsd(ROOT / "examples/car_park.jpg", detector=stranger).status == "ok"


def test_a_scene_without_vehicles_never_gets_a_confident_answer(detector: Detector) -> None:
    assert estimate_gsd(ROOT / "examples/scenes/no_cars.jpg", detector=detector).status != "ok"


@pytest.mark.slow
def test_any_number_of_threads_gives_the_same_bytes(car_park: np.ndarray) -> None:
    records = {
        estimate_gsd(
            car_park[:400], detector=str(resolve_model()), threads=threads
        ).model_dump_json()
        for threads in (1, 2, 2)
    }
    assert len(records) == 1


def _sha256(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_the_bundled_detector_is_the_measured_one() -> None:
    path = resolve_model(DEFAULT_DETECTOR)
    assert _sha256(path) in (ROOT / "research/results/scale.json").read_text(encoding="utf-8")


def test_the_bundled_detector_is_small() -> None:
    assert resolve_model(DEFAULT_DETECTOR).stat().st_size <= 8_000_000


def test_the_listed_checksums_are_those_of_the_bundled_networks() -> None:
    """If this fails, run ``sha256sum *.onnx > SHA256SUMS`` in the folder of bundled models."""
    lines = [f"{_sha256(path)}  {path.name}" for path in sorted(_BUNDLED.glob("*.onnx"))]
    assert (_BUNDLED / "SHA256SUMS").read_text(encoding="utf-8").splitlines() == lines


def test_every_bundled_network_is_in_a_model_card() -> None:
    cards = "".join(path.read_text(encoding="utf-8") for path in _BUNDLED.glob("*.md"))
    assert [model.file for model in BUNDLED_MODELS if f"`{model.file}`" not in cards] == []


def test_the_bundled_detector_has_its_name_and_licence(detector: Detector) -> None:
    assert detector.card.name == DEFAULT_DETECTOR
    assert detector.card.licence == "Apache-2.0"
    assert detector.card.length_range_px == (9.0, 64.0)


def test_the_reference_length_lies_between_those_of_the_regions(detector: Detector) -> None:
    card = detector.card
    assert 4.0 < card.reference_length_m < 5.2
    lengths_m = card.region_lengths_m
    assert lengths_m["europe"] < card.reference_length_m < lengths_m["north_america"]


def test_every_region_has_a_length_of_bodies(detector: Detector) -> None:
    assert detector.card.bodies is not None
    regions = set(detector.card.bodies.region_lengths_m)
    assert regions == set(REGIONS)
    assert set(detector.card.region_lengths_m) <= regions


@pytest.mark.data
@pytest.mark.slow
def test_real_photographs_of_known_scale(real_data: Path, detector: Detector) -> None:
    table = survey_table(real_data / "gsd" / "table.csv")
    images = [
        image
        for image in table.images
        if image.split == "val" and (image.labelled_vehicles or 0) >= 5
    ]
    # research/benchmarks/detector.py takes all of them.
    summary = summarise(run_trials(images[::3], detector))
    assert summary.images == 35
    assert summary.median <= 0.08
    assert summary.coverage >= 0.9


@pytest.mark.data
@pytest.mark.slow
def test_photographs_without_vehicles_rarely_get_a_confident_answer(
    real_data: Path, detector: Detector
) -> None:
    table = survey_table(real_data / "gsd" / "table.csv")
    images = [image for image in table.images if image.set == "empty" and image.split == "val"]
    trials = run_trials(images, detector)
    confident = [trial for trial in trials if trial.analysis.estimate.status == "ok"]
    assert len(confident) <= 1
